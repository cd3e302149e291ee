//! Lists the skipped tests and the reasons. It is the last test binary by name, so that its output is at the end of `cargo test`.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

#[allow(dead_code, reason = "the tests that need something use the rest")]
mod needs;

use std::io::Write as _;

#[test]
fn skipped_tests_are_listed_and_in_ci_no_tool_is_missing() {
    let skipped = needs::skipped();
    // Written to stderr directly, because the test harness shows the output of a test only if it fails.
    let mut out = std::io::stderr().lock();
    writeln!(out, "\n{} tests were skipped, wholly or in part:", skipped.len()).unwrap();
    for line in &skipped {
        writeln!(out, "  {line}").unwrap();
    }
    let missing: Vec<&String> = skipped.iter().filter(|line| line.contains(".ci/tools")).collect();
    assert!(!needs::in_ci() || missing.is_empty(), "CI=true, and tools are missing: {missing:?}");
}

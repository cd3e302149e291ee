//! Commands that print to a reader which leaves early, as `head` does.

use std::process::Stdio;

use crate::operations::world::program;

#[test]
fn a_reader_that_leaves_early_ends_a_command_without_a_message() {
    let population = ["--parameter", "k1=6,0.1", "--parameter", "k2=6,0.1", "--parameter", "k3=6,0.1"];
    let mut child =
        program(&[&["simulate", "--structure", "three-dof", "--measurements", "5000"], &population[..]].concat())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    let message = String::from_utf8_lossy(&output.stderr);
    // The status that shells report for a command that the signal SIGPIPE ended.
    assert_eq!(output.status.code(), Some(141), "{message}");
    assert_eq!(message, "");
}

//! Each room of the house uses only rooms below it: the table of `lib.rs`, held against every `crate::` in `src`.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

// `fault` is for the tests inside the modules.
const FOUNDATION: [&str; 5] = ["quantity", "stats", "parameter", "measurement", "fault"];

/// Module, the modules it may use besides itself, and whether the whole foundation is among them.
const TABLE: [(&str, &[&str], bool); 33] = [
    // Where tests make things fail: a macro that needs nothing.
    ("fault", &[], false),
    ("quantity", &[], false),
    ("access", &[], true),
    ("stats", &[], false),
    ("volume", &[], false),
    ("plot", &["stats"], false),
    ("reduction", &[], false),
    ("parameter", &["quantity", "stats"], false),
    ("measurement", &["quantity", "stats", "parameter"], false),
    ("physics", &["quantity", "stats"], false),
    ("emulator", &["stats"], false),
    ("gsa", &["stats"], false),
    ("flow", &["stats"], false),
    ("simulator", &["emulator", "physics"], true),
    ("updating", &["physics", "simulator"], true),
    ("posterior", &[], true),
    // `physics` for the error of a simulation only.
    ("baseline", &["flow", "simulator", "posterior", "physics"], true),
    ("hierarchy", &["posterior"], true),
    ("trust", &["baseline", "simulator", "physics"], true),
    ("discrepancy", &["physics", "plot", "simulator"], true),
    ("damage", &["hierarchy", "posterior"], true),
    ("alarm", &["damage"], true),
    (
        "assessment",
        &["alarm", "baseline", "damage", "hierarchy", "physics", "plot", "posterior", "simulator", "trust"],
        true,
    ),
    ("store", &["access", "alarm", "assessment", "damage", "reduction", "trust", "volume"], true),
    ("notify", &["store"], true),
    ("mqtt", &["monitor"], true),
    ("telemetry", &[], false),
    // A study of the methods, the assessment of a batch included.
    ("reproduce", &["assessment", "baseline", "damage", "gsa", "physics", "plot", "simulator", "updating"], true),
    (
        "monitor",
        &["alarm", "assessment", "baseline", "damage", "discrepancy", "flow", "reduction", "simulator", "store"],
        true,
    ),
    (
        "http",
        &[
            "access",
            "alarm",
            "assessment",
            "baseline",
            "damage",
            "discrepancy",
            "monitor",
            "notify",
            "reduction",
            "simulator",
            "store",
            "trust",
        ],
        true,
    ),
    ("config", &["access", "http", "monitor", "mqtt", "notify", "store", "telemetry"], false),
    (
        "cli",
        &[
            "access",
            "alarm",
            "assessment",
            "baseline",
            "config",
            "damage",
            "discrepancy",
            "flow",
            "http",
            "monitor",
            "mqtt",
            "notify",
            "plot",
            "reproduce",
            "simulator",
            "store",
            "telemetry",
            "updating",
            "volume",
        ],
        true,
    ),
    ("lib", &[], false),
];

fn may_use(module: &str) -> Vec<&'static str> {
    let (_, own, foundation) = TABLE
        .iter()
        .find(|(name, ..)| *name == module || (*name == "lib" && module == "main"))
        .unwrap_or_else(|| panic!("module {module} has no row in this table: give it one"));
    own.iter().copied().chain(FOUNDATION.into_iter().filter(|_| *foundation)).collect()
}

fn sources(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let nested = entries.flat_map(|path| if path.is_dir() { sources(&path) } else { vec![path] });
    nested.filter(|path| path.extension().is_some_and(|e| e == "rs")).collect()
}

/// First segment of a path below `src`: the module.
fn module_of(path: &Path, root: &Path) -> String {
    let first = path.strip_prefix(root).unwrap().components().next().unwrap();
    first.as_os_str().to_str().unwrap().trim_end_matches(".rs").to_owned()
}

#[test]
fn each_module_uses_only_modules_below_it() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut seen = BTreeSet::new();
    for path in sources(&root) {
        let module = module_of(&path, &root);
        let allowed = may_use(&module);
        for (number, line) in fs::read_to_string(&path).unwrap().lines().enumerate() {
            for used in line.split("crate::").skip(1) {
                let used = used.split(|c: char| !c.is_alphanumeric() && c != '_').next().unwrap();
                let fine = used == module || allowed.contains(&used);
                assert!(fine, "{}:{}: {module} uses {used}", path.display(), number + 1);
            }
        }
        seen.insert(module);
    }
    assert!(seen.len() > 15, "only {} modules were found", seen.len());
}

#[test]
fn only_the_store_speaks_sql_and_only_the_doors_speak_http() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    for path in sources(&root) {
        let (module, text) = (module_of(&path, &root), fs::read_to_string(&path).unwrap());
        assert!(module == "store" || !text.contains("sqlx::"), "{} uses sqlx", path.display());
        assert!(module == "http" || !text.contains("axum::"), "{} uses axum", path.display());
        let tensors = ["flow", "baseline"].contains(&module.as_str());
        assert!(tensors || !text.contains("candle_core::"), "{} uses tensors", path.display());
    }
}

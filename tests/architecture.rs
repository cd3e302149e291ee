//! The rules of the source tree: which module may use which, no circles of files, and limits for files, functions and types.
//!
//! `cargo test --test architecture figures -- --ignored --nocapture` prints the measured figures.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

#[path = "architecture/measures.rs"]
mod measures;
#[path = "architecture/paths.rs"]
mod paths;
#[path = "architecture/tree.rs"]
mod tree;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use tree::{rust_files, Edge, Tree};

/// Name and first file of each crate.
const CRATES: [(&str, &str); 5] = [
    ("structures", "crates/structures/src/lib.rs"),
    ("inference", "crates/inference/src/lib.rs"),
    ("discrepancy", "crates/discrepancy/src/lib.rs"),
    ("modalwatch", "src/lib.rs"),
    ("main", "src/main.rs"),
];
/// Folders whose files are sources, and folders whose files are tests.
const SOURCES: [&str; 4] = ["src", "crates/structures/src", "crates/inference/src", "crates/discrepancy/src"];
/// A crate that is one module.
const ONE_MODULE: &str = "crates/discrepancy/src";
const TESTS: [&str; 2] = ["tests", "benches"];

const MOST_LINES_OF_A_SOURCE: usize = 500;
const MOST_LINES_OF_A_TEST: usize = 700;
const MOST_LINES_OF_A_FUNCTION: usize = 80;
const MOST_PARAMETERS: usize = 7;
const MOST_METHODS: usize = 25;
/// Modules whose types have at most `MOST_METHODS` methods.
const FEW_METHODS: [&str; 2] = ["src/store", "src/monitor"];

/// Exceptions from the limits, each with its reason: `file`, `file: function`, `file: Type`, or `file -> file` for a use that
/// closes a circle.
const EXCEPTIONS: [(&str, &str); 0] = [];

// `fault` is used by the unit tests in the modules; `clock` is the only reader of the system clock.
const FOUNDATION: [&str; 6] = ["quantity", "stats", "parameter", "measurement", "fault", "clock"];

/// Module, the modules it may use besides itself, and whether the whole foundation is among them.
///
/// The modules of the crates below the service may use all of the crates below theirs, as `Cargo.toml` says; for them the rows have the
/// modules of the same crate. `src/lib.rs` names all modules of those crates, so that the service's rows have both.
const TABLE: [(&str, &[&str], bool); 36] = [
    // The crate `structures`
    ("quantity", &[], false),
    ("stats", &[], false),
    ("simd", &[], false),
    ("plot", &["stats"], false),
    ("parameter", &["quantity", "stats"], false),
    ("measurement", &["quantity", "stats", "parameter"], false),
    ("physics", &["quantity", "stats"], false),
    ("emulator", &["stats"], false),
    ("gsa", &["stats"], false),
    // `plot` for the drawing of a structure.
    ("simulator", &["emulator", "physics", "plot"], true),
    ("updating", &["physics", "simulator"], true),
    // The crate `inference`
    ("flow", &[], false),
    ("posterior", &[], false),
    ("baseline", &["flow", "posterior"], false),
    ("hierarchy", &["posterior"], false),
    ("trust", &["baseline"], false),
    ("process", &[], false),
    ("damage", &["hierarchy", "posterior", "process"], false),
    ("alarm", &["damage", "process"], false),
    ("assessment", &["alarm", "baseline", "damage", "hierarchy", "posterior", "process", "trust"], false),
    // The service
    // A macro for fault injection in tests; it uses no other module.
    ("fault", &[], false),
    ("clock", &["quantity"], true),
    ("access", &[], true),
    ("volume", &[], false),
    ("private", &[], false),
    ("reduction", &[], false),
    ("store", &["access", "alarm", "assessment", "damage", "process", "reduction", "trust", "volume", "private"], true),
    ("notify", &["alarm", "process", "store"], true),
    ("mqtt", &["monitor"], true),
    ("telemetry", &[], false),
    // Compares the methods, including the assessment of a batch.
    ("reproduce", &["assessment", "baseline", "damage", "gsa", "physics", "plot", "simulator", "updating"], true),
    (
        "monitor",
        &[
            "alarm",
            "assessment",
            "baseline",
            "damage",
            "discrepancy",
            "flow",
            "reduction",
            "simulator",
            "store",
            "trust",
        ],
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
            // The condition report is a page with plots.
            "plot",
            "process",
            "reduction",
            "simulator",
            "store",
            "trust",
        ],
        true,
    ),
    ("config", &["access", "http", "monitor", "mqtt", "notify", "quantity", "store", "telemetry"], false),
    (
        "cli",
        &[
            "private",
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
            "process",
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
        .unwrap_or_else(|| panic!("module {module} has no row in this table: add one"));
    own.iter().copied().chain(FOUNDATION.into_iter().filter(|_| *foundation)).collect()
}

fn root() -> PathBuf {
    let folder = std::env::var_os("CARGO_MANIFEST_DIR");
    folder.map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).to_owned(), PathBuf::from)
}

fn tree() -> Tree {
    Tree::read(&root(), &CRATES)
}

fn sources() -> Vec<PathBuf> {
    SOURCES.iter().flat_map(|folder| rust_files(&root(), folder)).collect()
}

/// First part of a path below its folder of sources: the module.
fn module_of(file: &Path) -> String {
    if file.starts_with(ONE_MODULE) {
        return "discrepancy".to_owned();
    }
    let below = SOURCES.iter().find_map(|folder| file.strip_prefix(folder).ok()).unwrap();
    let first = below.components().next().unwrap();
    first.as_os_str().to_str().unwrap().trim_end_matches(".rs").to_owned()
}

/// A violation of a rule: its place as written in `EXCEPTIONS`, and the message.
type Violation = (String, String);

fn is_excepted(place: &str) -> bool {
    EXCEPTIONS.iter().any(|(exception, _)| *exception == place)
}

/// Fails with one line for each violation, except for those that `EXCEPTIONS` lists.
fn assert_none(violations: Vec<Violation>) {
    let lines = violations.into_iter().filter(|(place, _)| !is_excepted(place)).map(|(_, line)| line);
    let lines: Vec<String> = lines.collect();
    assert!(lines.is_empty(), "{} violations:\n{}", lines.len(), lines.join("\n"));
}

#[test]
fn each_module_uses_only_modules_below_it() {
    let mut used: BTreeSet<(String, usize, String)> = BTreeSet::new();
    for file in sources().into_iter().filter(|file| !file.starts_with(ONE_MODULE)) {
        // Links in comments must obey the table, too.
        for (number, line) in fs::read_to_string(root().join(&file)).unwrap().lines().enumerate() {
            for name in line.split("crate::").skip(1) {
                let name = name.split(|c: char| !c.is_alphanumeric() && c != '_').next().unwrap();
                used.insert((file.to_str().unwrap().to_owned(), number + 1, name.to_owned()));
            }
        }
    }
    let tree = tree();
    for (module, mention) in tree.mentions() {
        let file = tree.files[tree.modules[module].file].clone();
        if let Some(name) = tree.top_module(module, &mention.path).filter(|_| !file.starts_with(ONE_MODULE)) {
            used.insert((file, mention.line, name));
        }
    }
    let files = sources().into_iter().filter(|file| !file.starts_with(ONE_MODULE));
    let modules: BTreeSet<String> = files.map(|file| module_of(&file)).collect();
    assert!(modules.len() > 15, "only {} modules were found", modules.len());
    for module in &modules {
        may_use(module); // Each has a row in the table.
    }
    let wrong = used.into_iter().filter_map(|(file, line, name)| {
        let module = module_of(Path::new(&file));
        let allowed = name == module || may_use(&module).contains(&name.as_str());
        (!allowed).then(|| (format!("{file}: {name}"), format!("{file}:{line}: {module} may not use {name}")))
    });
    assert_none(wrong.collect());
}

#[test]
fn only_the_store_uses_sqlx_and_only_http_uses_axum() {
    for path in sources() {
        let (module, text) = (module_of(&path), fs::read_to_string(root().join(&path)).unwrap());
        assert!(
            module == "store" || !(text.contains("sqlx::") || text.contains("sqlx_")),
            "{} uses sqlx",
            path.display()
        );
        assert!(module == "http" || !text.contains("axum::"), "{} uses axum", path.display());
        let tensors = ["flow", "baseline"].contains(&module.as_str());
        assert!(tensors || !text.contains("candle_core::"), "{} uses tensors", path.display());
    }
}

/// The last name of a path before the names of associated items: `super::select::Search::new` is `Search`.
fn short(path: &str) -> &str {
    let mut names = path.split("::");
    let last = names.clone().last().unwrap();
    names.find(|name| name.starts_with(char::is_uppercase)).unwrap_or(last)
}

/// The circles, one text each: its files, and which line of which file uses what of another.
fn describe_circles(tree: &Tree, edges: &[Edge]) -> Vec<String> {
    let circles = measures::circles(edges).into_iter().map(|files| {
        let mut uses: BTreeMap<(&str, &str), (usize, BTreeSet<&str>)> = BTreeMap::new();
        for edge in edges.iter().filter(|edge| files.contains(&edge.from) && files.contains(&edge.to)) {
            let (from, to) = (&tree.files[edge.from], &tree.files[edge.to]);
            uses.entry((from, to)).or_insert((edge.line, BTreeSet::new())).1.insert(short(&edge.path));
        }
        let uses = uses.iter().map(|((from, to), (line, names))| {
            let names: Vec<&str> = names.iter().copied().collect();
            format!("  {from}:{line}: uses {to} ({})", names.join(", "))
        });
        let names: Vec<&str> = files.iter().map(|&file| tree.files[file].as_str()).collect();
        let head = format!("{} files in a circle: {}", names.len(), names.join(", "));
        std::iter::once(head).chain(uses).collect::<Vec<_>>().join("\n")
    });
    circles.collect()
}

/// The name of a use of one file by another in `EXCEPTIONS`.
fn place(tree: &Tree, edge: &Edge) -> String {
    format!("{} -> {}", tree.files[edge.from], tree.files[edge.to])
}

#[test]
fn no_files_use_each_other_in_a_circle() {
    let tree = tree();
    let mut edges = tree.edges();
    assert!(edges.len() > tree.files.len(), "only {} uses of one file by another were found", edges.len());
    edges.retain(|edge| !is_excepted(&place(&tree, edge)));
    assert_none(describe_circles(&tree, &edges).into_iter().map(|text| (String::new(), text)).collect());
}

fn large_functions(tree: &Tree) -> Vec<Violation> {
    let functions = measures::functions(tree);
    assert!(functions.len() > 1000, "only {} functions were found", functions.len());
    let violations = functions.iter().flat_map(|function| {
        let place = format!("{}: {}", function.file, function.name);
        let at = format!("{}:{}: {}", function.file, function.line, function.name);
        let (lines, parameters) = (function.lines, function.parameters);
        let long = (lines > MOST_LINES_OF_A_FUNCTION)
            .then(|| format!("{at} has {lines} lines, {MOST_LINES_OF_A_FUNCTION} are allowed"));
        let wide = (parameters > MOST_PARAMETERS)
            .then(|| format!("{at} has {parameters} parameters, {MOST_PARAMETERS} are allowed"));
        long.into_iter().chain(wide).map(move |text| (place.clone(), text))
    });
    violations.collect()
}

#[test]
fn functions_are_short_and_have_few_parameters() {
    assert_none(large_functions(&tree()));
}

/// Unit tests in files named `tests.rs` have the limit of tests.
fn most_lines(file: &str) -> usize {
    let test = file.ends_with("/tests.rs") || !SOURCES.iter().any(|folder| Path::new(file).starts_with(folder));
    if test {
        MOST_LINES_OF_A_TEST
    } else {
        MOST_LINES_OF_A_SOURCE
    }
}

/// Each file below these folders with its lines.
fn lengths(folders: &[&str]) -> Vec<(String, usize)> {
    folders.iter().flat_map(|folder| measures::lengths(&root(), folder)).collect()
}

fn long_files() -> Vec<Violation> {
    let lengths = lengths(&SOURCES).into_iter().chain(lengths(&TESTS));
    let violations = lengths.filter(|(file, lines)| *lines > most_lines(file)).map(|(file, lines)| {
        let text = format!("{file}:{lines}: the file has {lines} lines, {} are allowed", most_lines(&file));
        (file, text)
    });
    violations.collect()
}

#[test]
fn files_are_short() {
    assert_none(long_files());
}

fn large_types(tree: &Tree) -> Vec<Violation> {
    let types = measures::types(tree);
    assert!(types.len() > 100, "only {} types were found", types.len());
    let held = types.iter().filter(|found| FEW_METHODS.iter().any(|folder| Path::new(&found.file).starts_with(folder)));
    let violations = held.filter(|found| found.methods > MOST_METHODS).map(|found| {
        let (file, line, name) = (&found.file, found.line, &found.name);
        let (methods, files) = (found.methods, found.files.len());
        let text = format!("{file}:{line}: {name} has {methods} methods in {files} files, {MOST_METHODS} are allowed");
        (format!("{file}: {name}"), text)
    });
    violations.collect()
}

#[test]
fn no_type_of_the_store_or_the_monitor_has_many_methods() {
    assert_none(large_types(&tree()));
}

#[test]
fn every_exception_is_still_needed() {
    let tree = tree();
    let violations = [long_files(), large_functions(&tree), large_types(&tree)].concat();
    let mut places: BTreeSet<String> = violations.into_iter().map(|(place, _)| place).collect();
    let edges = tree.edges();
    for circle in measures::circles(&edges) {
        let within = edges.iter().filter(|edge| circle.contains(&edge.from) && circle.contains(&edge.to));
        places.extend(within.map(|edge| place(&tree, edge)));
    }
    let stale: Vec<_> = EXCEPTIONS.iter().filter(|(place, _)| !places.contains(*place)).collect();
    assert!(stale.is_empty(), "these exceptions are not needed: {stale:?}");
}

#[test]
#[ignore = "prints figures and checks nothing"]
fn figures() {
    let (tree, root) = (tree(), root());
    let sources = lengths(&SOURCES);
    let lines: usize = sources.iter().map(|(_, lines)| lines).sum();
    println!("{lines} lines in {} files of {}", sources.len(), SOURCES.join(", "));
    let above_400 = sources.iter().filter(|(_, lines)| *lines > 400).count();
    let long = long_files();
    println!(
        "\nfiles above their limit: {} (files of {} above 400 lines: {above_400})",
        long.len(),
        SOURCES.join(", ")
    );
    for (_, text) in &long {
        println!("  {text}");
    }
    let functions = measures::functions(&tree);
    let above = |limit: usize| functions.iter().filter(|function| function.lines > limit).count();
    println!(
        "\nfunctions: {}, above {MOST_LINES_OF_A_FUNCTION} lines: {}, above 50: {}",
        functions.len(),
        above(80),
        above(50)
    );
    for function in functions.iter().take(20) {
        println!("  {:5} {}:{} {}", function.lines, function.file, function.line, function.name);
    }
    let wide = functions.iter().filter(|function| function.parameters > MOST_PARAMETERS);
    println!("\nfunctions with more than {MOST_PARAMETERS} parameters: {}", wide.clone().count());
    for function in wide {
        println!("  {:5} {}:{} {}", function.parameters, function.file, function.line, function.name);
    }
    println!("\ntypes with most methods");
    for found in measures::types(&tree).iter().take(12) {
        let (methods, public, files) = (found.methods, found.public, found.files.len());
        println!("  {methods:5} {} ({public} public, in {files} files; {}:{})", found.name, found.file, found.line);
    }
    let mut edges = tree.edges();
    let circles = describe_circles(&tree, &edges);
    edges.retain(|edge| [edge.from, edge.to].iter().all(|&file| !tree.files[file].ends_with("mod.rs")));
    println!("\ncircles of files: {} (without mod.rs: {})", circles.len(), measures::circles(&edges).len());
    for circle in &circles {
        println!("{circle}");
    }
    let crates: BTreeSet<&str> = CRATES.iter().map(|(name, _)| *name).collect();
    let manifests = ["", "crates/structures", "crates/inference", "crates/discrepancy"];
    let direct = manifests.map(|folder| direct_dependencies(&root.join(folder).join("Cargo.toml")));
    let direct: BTreeSet<String> =
        direct.into_iter().flatten().filter(|name| !crates.contains(name.as_str())).collect();
    let packages = fs::read_to_string(root.join("Cargo.lock")).unwrap().matches("[[package]]").count();
    println!("\ndirect dependencies: {}, packages in Cargo.lock: {packages}", direct.len());
}

/// The names below `[dependencies]`.
fn direct_dependencies(manifest: &Path) -> Vec<String> {
    let text = fs::read_to_string(manifest).unwrap();
    let lines = text.lines().skip_while(|line| *line != "[dependencies]").skip(1);
    let lines = lines.take_while(|line| !line.starts_with('[')).filter(|line| line.contains(" = "));
    lines.map(|line| line.split([' ', '.']).next().unwrap().to_owned()).collect()
}

//! `modalwatch new`.

use crate::commands::world::World;

const BY_FLAGS: &[&str] = &[
    "new",
    "--id",
    "mast",
    "--mass",
    "m1=1e5",
    "--mass",
    "m2=8e4",
    "--spring",
    "k1=ground,m1,3e7",
    "--spring",
    "k2=m1,m2,2.5e7",
    "--parameter",
    "k1=0.5..1.5",
    "--noise",
    "0.2%",
    "--covariate",
    "temperature_c",
];

#[test]
fn flags_and_answers_write_the_same_file_which_check_accepts() {
    let world = World::new();
    let said = world.run(&[BY_FLAGS, &["--out", "flags.toml"]].concat());
    assert!(said.contains("modalwatch check flags.toml"), "{said}");
    // Each wrong answer is asked again.
    let answers = "No Id\nmast\nm1\nm1=1e5\nm2=8e4\n\nk1=ground,m1,3e7\nk2=m1,m2,2.5e7\n\nk1=3e7..4e7\nk1=0.5..1.5\n\n3\n2\n0.2\ntemperature_c\n";
    let output = world.run_with_input(&["new", "--out", "answers.toml"], answers);
    let asked = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{asked}");
    assert!(asked.contains("not a factor of the nominal stiffness") && asked.contains("from 1 to 2"), "{asked}");
    let [flags, answers] =
        ["flags.toml", "answers.toml"].map(|name| std::fs::read_to_string(world.path(name)).unwrap());
    assert_eq!(flags, answers);
    assert!(flags.contains("scale = true") && flags.contains("uniform = [0.5, 1.5]"), "{flags}");
    let unit = ["--parameter", "k2=1e7..4e7N/m", "--covariate", "wind=m/s", "--out", "units.toml"];
    world.run(&[BY_FLAGS, &unit].concat());
    let units = std::fs::read_to_string(world.path("units.toml")).unwrap();
    assert!(units.contains("uniform = [10000000.0, 40000000.0]") && units.contains("unit = \"m/s\""), "{units}");
    assert_eq!(units.matches("scale = true").count(), 1, "{units}");
    assert!(world
        .run(&["check", "units.toml"])
        .contains("uniform prior 50 to 150 % of nominal, nominal 100 % of nominal"));
    let checked = world.run(&["check", "flags.toml"]);
    assert!(checked.contains("ground ─k1─ [m1] ─k2─ [m2]"), "{checked}");
}

#[test]
fn a_file_is_not_replaced_and_a_mechanism_is_not_written() {
    let world = World::new();
    world.run(BY_FLAGS);
    let (status, said) = world.fails(BY_FLAGS);
    assert!(status == 1 && said.contains("mast.toml exists"), "{said}");
    world.run(&[BY_FLAGS, &["--replace"]].concat());
    let loose = [
        "new",
        "--id",
        "loose",
        "--mass",
        "m1=1",
        "--mass",
        "m2=1",
        "--spring",
        "k1=ground,m1,10",
        "--parameter",
        "k1=0.5..1.5",
        "--noise",
        "1%",
    ];
    let (_, said) = world.fails(&loose);
    assert!(said.contains("m2") && !world.path("loose.toml").exists(), "{said}");
    let (_, said) = world.fails(&[BY_FLAGS, &["--replace", "--parameter", "k7=0.5..1.5"]].concat());
    assert!(said.contains("there is no spring of this name"), "{said}");
}

#[test]
fn a_mean_and_a_standard_deviation_become_a_normal_prior() {
    let world = World::new();
    let parameters = ["--parameter", "k2=2.5e7+-2.5e6N/m", "--out", "normal.toml"];
    let by_flags: Vec<&str> =
        BY_FLAGS.iter().map(|flag| if *flag == "k1=0.5..1.5" { "k1=1.0±0.1" } else { flag }).collect();
    world.run(&[&by_flags, &parameters[..]].concat());
    let text = std::fs::read_to_string(world.path("normal.toml")).unwrap();
    assert!(text.contains("prior = { normal = { mean = 1.0, std = 0.1 } }"), "{text}");
    assert!(text.contains("prior = { normal = { mean = 25000000.0, std = 2500000.0 } }"), "{text}");
    assert!(text.contains("values beyond 0.6 to 1.4 are taken for impossible"), "{text}");
    let said = world.run(&["check", "normal.toml"]);
    assert!(
        said.contains(
            "normal prior of mean 100 % of nominal and standard deviation 10 % of nominal, 60 to 140 % of nominal"
        ),
        "{said}"
    );
    assert!(
        said.contains("normal prior of mean 25 MN/m and standard deviation 2.5 MN/m, 15 MN/m to 35 MN/m"),
        "{said}"
    );
    // A standard deviation with which a stiffness could be negative.
    let wide: Vec<&str> = by_flags.iter().map(|flag| if *flag == "k1=1.0±0.1" { "k1=1.0±0.3" } else { flag }).collect();
    let (_, said) = world.fails(&[&wide[..], &["--out", "wide.toml"]].concat());
    assert!(said.contains("a std below 0.25 keeps the prior above 0") && !world.path("wide.toml").exists(), "{said}");
}

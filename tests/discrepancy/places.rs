//! Constant effects, which no covariate gives away: a missing spring, a wrong mass and an attached body are told apart by where they
//! act, which mode shapes show. The same worlds are diagnosed with shapes at half of the masses and without shapes.

use super::{answer, in_parallel, list, names, world, Judged, Kind};

/// Kinds of constant effects, and the first seed of their worlds.
const KINDS: [(&str, u64); 3] = [("added_spring", 60_000), ("mass", 61_000), ("oscillator", 62_000)];

/// A world diagnosed with and without shapes.
struct Pair {
    with: Judged,
    without: Judged,
}

/// How many of some worlds are right.
#[derive(Debug)]
#[allow(dead_code, reason = "most counts are only printed")]
struct Counts {
    worlds: usize,
    /// With shapes: the effect is named, alone or among the few of an ambiguous answer; it is named first; it is named alone.
    named: usize,
    first: usize,
    alone: usize,
    /// With shapes: another effect is named with a probability above 0.9.
    confident_wrong: usize,
    /// With shapes: the size is comparable, and it is inside its 90 % interval.
    sizes: usize,
    inside: usize,
    /// Without shapes: the effect is named, alone or among the causes of an ambiguous answer; the same, or the answer is none of
    /// these; another effect is named with a probability above 0.9.
    named_without: usize,
    honest_without: usize,
    confident_wrong_without: usize,
    /// Without shapes: number of causes that the ambiguous answers name, in total.
    listed_without: usize,
}

/// Whether the hidden effect is the cause, or one of those of an ambiguous answer.
fn among_named(judged: &Judged) -> bool {
    let truth = &judged.world.truths[0];
    matches!(judged.verdict(), "cause" | "ambiguous") && list(&judged.answer, "causes").iter().any(|c| names(c, truth))
}

/// Whether one cause is named alone, and it is not the hidden effect.
fn alone_and_wrong(judged: &Judged) -> bool {
    judged.verdict() == "cause" && !among_named(judged)
}

fn counts(pairs: &[Pair]) -> Counts {
    let count = |good: &dyn Fn(&Pair) -> bool| pairs.iter().filter(|p| good(p)).count();
    let first = |p: &Pair| {
        let truth = &p.with.world.truths[0];
        among_named(&p.with) && list(&p.with.answer, "causes").first().is_some_and(|cause| names(cause, truth))
    };
    Counts {
        worlds: pairs.len(),
        named: count(&|p| among_named(&p.with)),
        first: count(&first),
        alone: count(&|p| among_named(&p.with) && p.with.verdict() == "cause"),
        confident_wrong: count(&|p| alone_and_wrong(&p.with)),
        sizes: count(&|p| p.with.size_inside.is_some()),
        inside: count(&|p| p.with.size_inside == Some(true)),
        named_without: count(&|p| among_named(&p.without)),
        honest_without: count(&|p| among_named(&p.without) || p.without.verdict() == "none_of_these"),
        confident_wrong_without: count(&|p| alone_and_wrong(&p.without)),
        listed_without: pairs
            .iter()
            .filter(|p| p.without.verdict() == "ambiguous")
            .map(|p| list(&p.without.answer, "causes").len())
            .sum(),
    }
}

/// Diagnoses `worlds` worlds of a kind with and without shapes, and prints what is missed.
fn pairs(kind: &'static str, first_seed: u64, worlds: u64) -> Vec<Pair> {
    let seeds: Vec<u64> = (first_seed..first_seed + worlds).collect();
    let pairs = in_parallel(&seeds, |seed| {
        let world = world::draw_single(*seed, kind, "constant");
        let (toml, csv) = world.with_shapes();
        let with = answer(&toml, &csv, &[]);
        let without = answer(&world.structure_toml, &world.csv, &[]);
        let judged = |answer| Judged::new(Kind::Single, world.clone(), answer);
        Pair { with: judged(with), without: judged(without) }
    });
    for pair in &pairs {
        if !among_named(&pair.with) {
            println!("MISS with shapes: {}", pair.with.text());
        }
        if !among_named(&pair.without) && pair.without.verdict() != "none_of_these" {
            println!("MISS without shapes: {}", pair.without.text());
        }
    }
    pairs
}

fn all_kinds(worlds: u64) -> Vec<(&'static str, Counts)> {
    let of = |(kind, seed): &(&'static str, u64)| {
        let counts = counts(&pairs(kind, *seed, worlds));
        println!("{kind}: {counts:?}");
        (*kind, counts)
    };
    KINDS.iter().map(of).collect()
}

#[test]
fn shapes_tell_where_a_constant_effect_acts_in_a_few_worlds() {
    for (kind, counts) in all_kinds(6) {
        assert!(counts.named + 1 >= counts.worlds, "{kind}: {counts:?}");
    }
}

#[test]
#[ignore = "12 minutes"]
fn shapes_tell_where_a_constant_effect_acts_in_a_hundred_worlds_of_each_kind() {
    for (kind, counts) in all_kinds(100) {
        assert!(counts.named >= 90, "{kind}: {counts:?}");
        assert!(counts.honest_without >= 90, "{kind}: {counts:?}");
    }
}

//! The figures of `modalwatch check` as text.

use super::figures::{Figures, ModeFigures, ParameterFigures};
use crate::parameter::{DamageDirection, PriorForm};
use crate::quantity::{significant, with_prefix};
use crate::simulator::definition::{CovariateDefinition, MeasurementNoise, SpringDefinition, StructureDefinition};

/// Most points of a shape that are printed beside a mode.
const MOST_POINTS: usize = 12;

impl Figures {
    /// Prints all figures in lines of at most about 100 columns.
    pub fn print(&self, definition: &StructureDefinition) {
        let noise = match definition.measurement_noise {
            MeasurementNoise::Relative(share) => format!("{} % of the frequency", significant(100.0 * share)),
            MeasurementNoise::Hz(hz) => format!("{} Hz", significant(hz)),
        };
        println!(
            "{}: {} masses, {} springs, {} beams, {} parameters, {} measured modes, noise of one frequency {noise}",
            self.structure,
            definition.masses.len(),
            definition.springs.len(),
            definition.beams.len(),
            self.parameters.len(),
            self.modes.len()
        );
        print_parts(definition);
        self.print_parameters();
        self.print_modes();
        self.print_sensitivities();
        self.print_identifiability();
        for note in &self.notes {
            println!("note: {note}");
        }
        for problem in &self.problems {
            println!("PROBLEM: {problem}");
        }
    }

    fn print_parameters(&self) {
        println!("\nparameters");
        let width = self.parameters.iter().map(|p| p.name.chars().count()).max().unwrap_or(0);
        for p in &self.parameters {
            let damage = match p.damage {
                DamageDirection::Decrease => "damage is a decrease",
                DamageDirection::Increase => "damage is an increase",
                DamageDirection::None => "no change is damage",
            };
            let sets = if p.sets.is_empty() { String::new() } else { format!("; sets {}", p.sets.join(", ")) };
            let nominal = with_prefix(p.nominal, &p.unit);
            let [low, high] = p.prior;
            // Per cent take no prefix, so that the unit is needed only once.
            let low = if p.unit.starts_with('%') { significant(low) } else { with_prefix(low, &p.unit) };
            let high = with_prefix(high, &p.unit);
            let prior = match p.prior_form {
                PriorForm::Uniform => format!("uniform prior {low} to {high}"),
                PriorForm::Normal { mean, std } => {
                    let [mean, std] = [mean, std].map(|value| with_prefix(value, &p.unit));
                    format!("normal prior of mean {mean} and standard deviation {std}, {low} to {high}")
                }
                PriorForm::LogNormal { median, ln_std } => format!(
                    "log-normal prior of median {} and relative standard deviation {} %, {low} to {high}",
                    with_prefix(median, &p.unit),
                    significant(100.0 * ln_std.powi(2).exp_m1().sqrt())
                ),
            };
            println!("  {:width$}  {prior}, nominal {nominal}; {damage}{sets}", p.name);
        }
    }

    fn print_modes(&self) {
        let measured = self.modes.iter().any(|m| m.measured_hz.is_some());
        let title = if measured { "  measured" } else { "" };
        println!("\nmodes at the nominal parameters, and their range within the prior, Hz");
        println!("  mode   nominal  noise std            prior range{title}");
        for m in &self.modes {
            let range = format!("{} to {}", significant(m.prior_hz[0]), significant(m.prior_hz[1]));
            let measured = m.measured_hz.map_or_else(String::new, |f| {
                let verdict = if m.measured_is_possible == Some(true) { "inside" } else { "OUTSIDE" };
                format!("  {} {verdict}", significant(f))
            });
            println!(
                "  {:>4} {:>9} {:>10} {range:>22}{measured}",
                m.mode,
                significant(m.nominal_hz),
                significant(m.noise_std_hz)
            );
        }
        if !self.shape_points.is_empty() && self.shape_points.len() <= MOST_POINTS {
            let width = self.shape_points.iter().map(|name| name.chars().count()).max().unwrap_or(0).max(6);
            let head: Vec<String> = self.shape_points.iter().map(|name| format!("{name:>width$}")).collect();
            println!("\nmode shapes, largest displacement 1\n  mode {}", head.join(" "));
            for m in &self.modes {
                let row: Vec<String> = m.shape.iter().map(|v| format!("{v:>width$.3}")).collect();
                println!("  {:>4} {}", m.mode, row.join(" "));
            }
        }
    }

    fn print_sensitivities(&self) {
        if self.parameters.is_empty() {
            return;
        }
        println!(
            "\nchange of a frequency, %, when a parameter rises by 1 % (of its prior's width, if that includes 0)"
        );
        let width = self.parameters.iter().map(|p| p.name.chars().count()).max().unwrap_or(0).max(7);
        let head: Vec<String> = self.parameters.iter().map(|p| format!("{:>width$}", p.name)).collect();
        println!("  mode {}", head.join(" "));
        let row =
            |m: &ModeFigures| m.sensitivity.iter().map(|s| format!("{s:>width$.4}")).collect::<Vec<_>>().join(" ");
        self.modes.iter().for_each(|m| println!("  {:>4} {}", m.mode, row(m)));
    }

    fn print_identifiability(&self) {
        println!("\nwhat one complete measurement says about each parameter");
        let width = self.parameters.iter().map(|p| p.name.chars().count()).max().unwrap_or(0);
        let share = |p: &ParameterFigures| 100.0 * p.std / p.nominal.abs().max(f64::MIN_POSITIVE);
        for p in &self.parameters {
            println!(
                "  {:width$}  standard deviation {} ({:.2} %); {:.2} % of the prior variance are left",
                p.name,
                with_prefix(p.std, &p.unit),
                share(p),
                100.0 * p.variance_left
            );
        }
        let condition = self.condition.map_or_else(|| "infinite".to_owned(), significant);
        println!("  condition number of the sensitivities: {condition} (1 is best; above 100 small errors move the parameters far)");
    }
}

/// Masses, springs and beams; a chain from the ground also as a line.
fn print_parts(definition: &StructureDefinition) {
    if let Some(chain) = chain(definition) {
        println!("\n  {chain}");
    }
    if !definition.masses.is_empty() {
        println!("\nmasses");
        for m in &definition.masses {
            let at = m.at.as_ref().map_or_else(String::new, |node| format!(" at {node}"));
            println!("  {}  {}{at}", m.name, with_prefix(m.kg, "kg"));
        }
    }
    if !definition.nodes.is_empty() {
        println!("\nnodes");
        for n in &definition.nodes {
            let support = format!("{:?}", n.support).to_lowercase();
            println!("  {}  x = {} m, {support}", n.name, significant(n.x_m));
        }
    }
    let by = |name: &str, beam: bool| {
        let sets = |p: &&crate::simulator::definition::ParameterDefinition| {
            p.sets
                .iter()
                .any(|s| if beam { s.beam.as_deref() == Some(name) } else { s.spring.as_deref() == Some(name) })
        };
        let names: Vec<&str> = definition.parameters.iter().filter(sets).map(|p| p.name.as_str()).collect();
        if names.is_empty() {
            String::new()
        } else {
            format!(", set by parameter {}", names.join(", "))
        }
    };
    let stiffness =
        |k: Option<f64>, unit: &str| k.map_or_else(|| "middle of the prior".to_owned(), |k| with_prefix(k, unit));
    if !definition.springs.is_empty() {
        println!("\nsprings");
        for s in &definition.springs {
            let k = s.n_m_per_rad.map_or_else(|| stiffness(s.n_per_m, "N/m"), |k| with_prefix(k, "N·m/rad"));
            println!("  {}  {} – {}: {k}{}", s.name, s.from, s.to, by(&s.name, false));
        }
    }
    if !definition.covariates.is_empty() {
        let with_unit = |c: &CovariateDefinition| match &c.unit {
            Some(unit) => format!("{} ({unit})", c.name),
            None => c.name.clone(),
        };
        println!("\ncovariates\n  {}", definition.covariates.iter().map(with_unit).collect::<Vec<_>>().join(", "));
    }
    if !definition.beams.is_empty() {
        println!("\nbeams");
        for b in &definition.beams {
            let k = stiffness(b.bending_stiffness_n_m2, "N·m²");
            println!(
                "  {}  {} – {}: {k}, {} kg/m{}",
                b.name,
                b.from,
                b.to,
                significant(b.mass_kg_per_m),
                by(&b.name, true)
            );
        }
    }
}

/// A chain of masses from the ground as a line, `ground ─k1─ [m1] ─k2─ [m2]`; `None` for another structure.
fn chain(definition: &StructureDefinition) -> Option<String> {
    if definition.masses.is_empty()
        || definition.springs.len() != definition.masses.len()
        || !definition.nodes.is_empty()
    {
        return None;
    }
    let mut left: Vec<&SpringDefinition> = definition.springs.iter().collect();
    let (mut here, mut line) = ("ground".to_owned(), vec!["ground".to_owned()]);
    while !left.is_empty() {
        let next: Vec<usize> = (0..left.len()).filter(|i| left[*i].from == here || left[*i].to == here).collect();
        let [only] = next[..] else { return None };
        let spring = left.remove(only);
        let other = if spring.from == here { &spring.to } else { &spring.from };
        line.push(format!("─{}─ [{other}]", spring.name));
        here.clone_from(other);
    }
    Some(line.join(" "))
}

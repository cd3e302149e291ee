//! `modalwatch new`: writes a structure file from flags or from answers on the terminal.

use std::fmt::Write as _;
use std::io::{BufRead, Write as _};
use std::path::PathBuf;

use anyhow::Context as _;
use clap::Args;

use super::output::write_whole;
use crate::quantity::{shown, significant, StructureId};
use crate::simulator::definition::StructureDefinition;
use crate::simulator::prior::{NormalPrior, Prior};
use crate::simulator::Simulator;

const EXAMPLE: &str = "Example: a tower of two storeys whose lower spring is unknown, without questions:

  modalwatch new --id tower --mass m1=1e5 --mass m2=8e4 --spring k1=ground,m1,3e7 --spring k2=m1,m2,2.5e7 \\
      --parameter k1=0.5..1.5 --modes 2 --noise 0.2% --covariate temperature_c --out tower.toml";

/// Write a structure file of masses and springs. What the flags do not give is asked on the terminal.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLE)]
pub struct NewArgs {
    /// Id of the structure: lower-case letters, digits and hyphens
    #[arg(long)]
    id: Option<String>,
    /// Mass as name=kg; once per mass
    #[arg(long = "mass", value_name = "NAME=KG", value_parser = mass)]
    masses: Vec<NewMass>,
    /// Spring as name=from,to,N/m, where one end may be `ground`; once per spring
    #[arg(long = "spring", value_name = "NAME=FROM,TO,N_PER_M", value_parser = spring)]
    springs: Vec<NewSpring>,
    /// Unknown stiffness of a spring, with the range of possible values as factors of its nominal stiffness, k1=0.5..1.5, or as
    /// stiffnesses, k1=1.5e7..4.5e7N/m; or with mean and standard deviation of a normal distribution, k1=1.0±0.1 or
    /// k1=3e7±3e6N/m (+- for ±); once per unknown spring
    #[arg(long = "parameter", value_name = "SPRING=LOW..HIGH", value_parser = unknown)]
    parameters: Vec<NewParameter>,
    /// Number of measured modes, from the lowest
    #[arg(long)]
    modes: Option<usize>,
    /// Standard deviation of a measured frequency, in per cent of it
    #[arg(long, value_name = "PERCENT%", value_parser = noise)]
    noise: Option<f64>,
    /// Covariate that is noted beside the frequencies, if wanted with its unit, such as temperature=°C; may be repeated
    #[arg(long = "covariate", value_name = "NAME[=UNIT]", value_parser = covariate)]
    covariates: Vec<NewCovariate>,
    /// File to write [default: <id>.toml]
    #[arg(long)]
    out: Option<PathBuf>,
    /// Replace an existing file
    #[arg(long)]
    replace: bool,
}

#[derive(Debug, Clone, PartialEq)]
struct NewMass {
    name: String,
    kg: f64,
}

#[derive(Debug, Clone, PartialEq)]
struct NewSpring {
    name: String,
    from: String,
    to: String,
    n_per_m: f64,
}

#[derive(Debug, Clone, PartialEq)]
struct NewParameter {
    spring: String,
    /// Prior as factors of the nominal stiffness, or as stiffnesses, N/m.
    prior: Prior,
    /// Whether the prior is one of stiffnesses.
    in_n_per_m: bool,
}

#[derive(Debug, Clone, PartialEq)]
struct NewCovariate {
    name: String,
    unit: Option<String>,
}

/// The answers from which a file is written.
struct Answers {
    id: String,
    masses: Vec<NewMass>,
    springs: Vec<NewSpring>,
    parameters: Vec<NewParameter>,
    modes: usize,
    noise: f64,
    covariates: Vec<NewCovariate>,
}

/// Asks for what the flags do not give, writes the file and says what to do next.
///
/// # Errors
/// Answers that do not describe a structure, a file that exists or cannot be written.
pub fn new(args: &NewArgs) -> anyhow::Result<()> {
    let answers = answers(args, &mut Terminal { input: std::io::stdin().lock() })?;
    let text = text(&answers)?;
    let refused = |e: crate::simulator::definition::DefinitionError| anyhow::anyhow!("this is not a structure: {e}");
    Simulator::new(StructureDefinition::parse_toml(&text).map_err(refused)?).map_err(refused)?;
    let out = args.out.clone().unwrap_or_else(|| PathBuf::from(format!("{}.toml", answers.id)));
    anyhow::ensure!(
        args.replace || !out.exists(),
        "{} exists: give another file with --out, or --replace",
        out.display()
    );
    write_whole(&out, text.as_bytes())?;
    println!("{} is written. Next:", out.display());
    println!("  modalwatch check {} --svg {}.svg    # look at it", out.display(), answers.id);
    println!("  modalwatch train --structure {}    # train its model", out.display());
    Ok(())
}

/// Questions and answers, one line each.
struct Terminal<R> {
    input: R,
}

impl<R: BufRead> Terminal<R> {
    /// Asks until `read` accepts the answer. An empty answer is `default`, if there is one.
    fn ask<T>(
        &mut self,
        question: &str,
        default: Option<&str>,
        read: impl Fn(&str) -> Result<T, String>,
    ) -> anyhow::Result<T> {
        loop {
            let line = self.line(question, default)?;
            let answer = if line.is_empty() { default.unwrap_or_default() } else { &line };
            match read(answer) {
                Ok(value) => return Ok(value),
                Err(message) => eprintln!("  {message}"),
            }
        }
    }

    /// Asks for items until an empty line.
    fn list<T>(
        &mut self,
        question: &str,
        fewest: usize,
        read: impl Fn(&str) -> Result<T, String>,
    ) -> anyhow::Result<Vec<T>> {
        let mut all = Vec::new();
        loop {
            let line = self.line(question, None)?;
            if line.is_empty() && all.len() >= fewest {
                return Ok(all);
            }
            match read(&line) {
                Ok(item) => all.push(item),
                Err(message) => eprintln!("  {message}"),
            }
        }
    }

    fn line(&mut self, question: &str, default: Option<&str>) -> anyhow::Result<String> {
        let default = default.map_or_else(String::new, |default| format!(" [{default}]"));
        eprint!("{question}{default}: ");
        std::io::stderr().flush()?;
        let mut line = String::new();
        let read = self.input.read_line(&mut line).context("the terminal cannot be read")?;
        anyhow::ensure!(
            read > 0,
            "there is no answer to \"{question}\": answer on the terminal, or give it by a flag (--help)"
        );
        Ok(line.trim().to_owned())
    }
}

fn answers<R: BufRead>(args: &NewArgs, terminal: &mut Terminal<R>) -> anyhow::Result<Answers> {
    let read_id = |text: &str| StructureId::parse(text).map(|id| id.to_string()).map_err(|e| e.to_string());
    let id = match &args.id {
        Some(id) => read_id(id).map_err(anyhow::Error::msg)?,
        None => terminal.ask("Id of the structure (lower-case letters, digits, hyphens)", Some("tower"), read_id)?,
    };
    // Whoever gives masses by flags has given all: a script is not asked for unknown stiffnesses or covariates.
    let by_flags = !args.masses.is_empty();
    let masses = if by_flags {
        args.masses.clone()
    } else {
        terminal.list("Mass as name=kg, such as m1=1e5 (empty line: no more)", 1, mass)?
    };
    let springs = if args.springs.is_empty() {
        terminal.list("Spring as name=from,to,N/m, such as k1=ground,m1,3e7 (empty line: no more)", 1, spring)?
    } else {
        args.springs.clone()
    };
    let parameters = if args.parameters.is_empty() {
        let known: Vec<&str> = springs.iter().map(|s| s.name.as_str()).collect();
        let question = format!("Unknown spring with its range as factors of the nominal stiffness, such as {}=0.5..1.5 (empty line: no more)", known[0]);
        terminal.list(&question, 1, unknown)?
    } else {
        args.parameters.clone()
    };
    let read_modes = |text: &str| {
        let found: Option<usize> = text.parse().ok().filter(|modes| (1..=masses.len()).contains(modes));
        found.ok_or_else(|| {
            format!("{} must be a number of modes from 1 to {}, the number of masses", shown(text), masses.len())
        })
    };
    let most = masses.len().to_string();
    let modes = match args.modes {
        Some(modes) => read_modes(&modes.to_string()).map_err(anyhow::Error::msg)?,
        None if by_flags => masses.len(),
        None => terminal.ask("Number of measured modes, from the lowest", Some(&most), read_modes)?,
    };
    let noise = match args.noise {
        Some(noise) => noise,
        None => terminal.ask("Standard deviation of a measured frequency, in per cent of it", Some("0.2%"), noise)?,
    };
    let covariates = if by_flags || !args.covariates.is_empty() {
        args.covariates.clone()
    } else {
        let read = |text: &str| text.split(',').map(str::trim).filter(|c| !c.is_empty()).map(covariate).collect();
        let question =
            "Covariates noted beside the frequencies, such as temperature=°C, separated by commas (may be empty)";
        terminal.ask(question, Some(""), read)?
    };
    Ok(Answers { id, masses, springs, parameters, modes, noise, covariates })
}

/// A text as TOML writes it.
fn quoted(text: &str) -> String {
    toml::Value::String(text.to_owned()).to_string()
}

/// A parameter with comments.
fn write_parameter(out: &mut String, p: &NewParameter, springs: &[NewSpring]) -> anyhow::Result<()> {
    let spring = springs.iter().find(|s| s.name == p.spring);
    let k = spring.with_context(|| format!("--parameter {}: there is no spring of this name", p.spring))?.n_per_m;
    let ([low, high], name) = (p.prior.bounds(), quoted(&p.spring));
    if p.in_n_per_m {
        writeln!(out, "\n# The unknown stiffness of {}, N/m.", p.spring)?;
    } else {
        let [from, to] = [low, high].map(|factor| significant(factor * k));
        writeln!(
            out,
            "\n# The unknown stiffness of {} as a factor of its nominal value: {from} to {to} N/m.",
            p.spring
        )?;
    }
    let (meaning, prior) = if let Prior::Normal(NormalPrior { mean, std }) = p.prior {
        let meaning = format!(
            "Mean and standard deviation, damaged states included; values beyond {} to {} are taken for impossible.",
            significant(low),
            significant(high)
        );
        (meaning, format!("normal = {{ mean = {mean:?}, std = {std:?} }}"))
    } else {
        let meaning = "The range holds every value that is possible, damaged states included.".to_owned();
        (meaning, format!("uniform = [{low:?}, {high:?}]"))
    };
    writeln!(out, "# {meaning}")?;
    writeln!(out, "[[parameter]]\nname = {name}")?;
    if !p.in_n_per_m {
        writeln!(out, "scale = true    # a factor of n_per_m; results are in per cent of it")?;
    }
    writeln!(out, "prior = {{ {prior} }}\nsets = {{ spring = {name} }}\ndamage = \"decrease\"")?;
    Ok(())
}

/// The structure file with comments.
fn text(answers: &Answers) -> anyhow::Result<String> {
    let mut text = String::new();
    let out = &mut text;
    writeln!(out, "# Structure file of modalwatch. Every key is explained in docs/structure-file.md (served at /docs/structure-file).")?;
    writeln!(
        out,
        "# Look at it: modalwatch check FILE --svg drawing.svg. Train its model: modalwatch train --structure FILE."
    )?;
    writeln!(out, "id = {}", quoted(&answers.id))?;
    writeln!(out, "modes = {}    # measured modes, from the lowest", answers.modes)?;
    writeln!(
        out,
        "# Standard deviation of one measured frequency as a share of it: the scatter of repeated measurements."
    )?;
    writeln!(out, "measurement_noise = {{ relative = {} }}", answers.noise)?;
    for m in &answers.masses {
        writeln!(out, "\n[[mass]]\nname = {}\nkg = {:?}", quoted(&m.name), m.kg)?;
    }
    for s in &answers.springs {
        writeln!(out, "\n[[spring]]\nname = {}\nfrom = {}\nto = {}", quoted(&s.name), quoted(&s.from), quoted(&s.to))?;
        writeln!(out, "n_per_m = {:?}    # nominal stiffness", s.n_per_m)?;
    }
    for p in &answers.parameters {
        write_parameter(out, p, &answers.springs)?;
    }
    for covariate in &answers.covariates {
        let name = quoted(&covariate.name);
        writeln!(out, "\n# Noted beside the frequencies, as a column of this name.\n[[covariate]]\nname = {name}")?;
        if let Some(unit) = &covariate.unit {
            writeln!(out, "unit = {}", quoted(unit))?;
        }
    }
    Ok(text)
}

fn positive(text: &str) -> Option<f64> {
    text.trim().parse().ok().filter(|number: &f64| number.is_finite() && *number > 0.0)
}

fn mass(text: &str) -> Result<NewMass, String> {
    let wrong = || format!("{} must have the form name=kg with a mass above 0, such as m1=1e5", shown(text));
    let (name, kg) = text.split_once('=').ok_or_else(wrong)?;
    Ok(NewMass { name: name.trim().to_owned(), kg: positive(kg).ok_or_else(wrong)? })
}

fn spring(text: &str) -> Result<NewSpring, String> {
    let wrong = || format!("{} must have the form name=from,to,N/m, such as k1=ground,m1,3e7", shown(text));
    let (name, rest) = text.split_once('=').ok_or_else(wrong)?;
    let parts: Vec<&str> = rest.split(',').map(str::trim).collect();
    let [from, to, stiffness] = parts[..] else { return Err(wrong()) };
    let n_per_m = positive(stiffness).ok_or_else(wrong)?;
    Ok(NewSpring { name: name.trim().to_owned(), from: from.to_owned(), to: to.to_owned(), n_per_m })
}

fn unknown(text: &str) -> Result<NewParameter, String> {
    let wrong = || {
        format!(
            "{} must have the form spring=LOW..HIGH with factors of the nominal stiffness, such as k1=0.5..1.5, or with stiffnesses, such \
             as k1=1.5e7..4.5e7N/m, or spring=MEAN±STD, such as k1=1.0±0.1",
            shown(text)
        )
    };
    let (name, range) = text.split_once('=').ok_or_else(wrong)?;
    let (range, in_n_per_m) = match range.trim().strip_suffix("N/m") {
        Some(stiffnesses) => (stiffnesses, true),
        None => (range, false),
    };
    let sign = ["±", "+-"].into_iter().find(|sign| range.contains(sign)).unwrap_or("..");
    let normal = sign != "..";
    let (first, second) = range.split_once(sign).ok_or_else(wrong)?;
    let [low, high] = [positive(first).ok_or_else(wrong)?, positive(second).ok_or_else(wrong)?];
    if !normal && low >= high {
        return Err(wrong());
    }
    if !in_n_per_m && low > 100.0 {
        return Err(format!(
            "{}: {low} is not a factor of the nominal stiffness; write {}, or add the unit to stiffnesses, {first}{sign}{second}N/m",
            shown(text),
            if normal { "1.0±0.1" } else { "0.5..1.5" }
        ));
    }
    let prior = if normal { Prior::Normal(NormalPrior { mean: low, std: high }) } else { Prior::Uniform([low, high]) };
    Ok(NewParameter { spring: name.trim().to_owned(), prior, in_n_per_m })
}

fn covariate(text: &str) -> Result<NewCovariate, String> {
    let (name, unit) = match text.split_once('=') {
        Some((name, unit)) => (name, Some(unit.trim().to_owned())),
        None => (text, None),
    };
    if name.trim().is_empty() || unit.as_ref().is_some_and(String::is_empty) {
        return Err(format!("{} must have the form name or name=unit, such as temperature=°C", shown(text)));
    }
    Ok(NewCovariate { name: name.trim().to_owned(), unit })
}

/// A share from per cent; the sign may be left out, because the question names it.
fn noise(text: &str) -> Result<f64, String> {
    let number = positive(text.trim().trim_end_matches('%')).filter(|percent| *percent < 50.0);
    number
        .map(|percent| percent / 100.0)
        .ok_or_else(|| format!("{} must be per cent above 0 and below 50, such as 0.2%", shown(text)))
}

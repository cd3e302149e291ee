//! `modalwatch check`: what a structure file says, and what its modes can tell, before anything is trained.

mod figures;
mod print;

use std::path::PathBuf;

use clap::Args;

use super::output::write_whole;
use crate::baseline::library::find_structure;
use crate::simulator::drawing::Marks;
use figures::Figures;

/// Show a structure: its parts, modes, sensitivities and what its modes can identify; nothing is trained.
#[derive(Debug, Args)]
pub struct CheckArgs {
    /// Structure file (TOML or JSON), or the id of a shipped structure
    #[arg(value_name = "STRUCTURE")]
    structure: String,
    /// Measured frequencies, Hz, from the lowest mode, separated by commas: are they possible within the prior?
    #[arg(long, value_name = "HZ,HZ,…", value_delimiter = ',')]
    measured: Vec<f64>,
    /// Write a drawing of the structure to this file
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
    /// With --svg: draw the shape of this mode, counted from 1
    #[arg(long, requires = "svg")]
    mode: Option<usize>,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// Prints what was found and writes the drawing.
///
/// # Errors
/// A structure file with mistakes, a drawing that cannot be made, and contradictions: measured frequencies outside the range of the
/// prior, a prior far from the nominal stiffness.
pub fn check(args: &CheckArgs) -> anyhow::Result<()> {
    let simulator = find_structure(&args.structure)?;
    let figures = Figures::of(&simulator, &args.measured)?;
    if let Some(path) = &args.svg {
        let nominal = simulator.nominal_parameters();
        let drawing = simulator.drawing(&Marks::default(), args.mode.map(|mode| (mode, nominal.as_slice())))?;
        write_whole(path, drawing.svg().as_bytes())?;
    }
    if args.json {
        println!("{}", serde_json::to_string_pretty(&figures)?);
    } else {
        figures.print(simulator.definition());
        if let Some(path) = &args.svg {
            println!("\ndrawing: {}", path.display());
        }
    }
    anyhow::ensure!(figures.problems.is_empty(), "{}", figures.problems.join("; "));
    Ok(())
}

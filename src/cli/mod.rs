//! The door for people: one function a command.

mod archive;
mod assess;
mod backup;
mod calibrate;
mod demo;
mod design_alarm;
mod diagnose;
mod doctor;
mod healthcheck;
mod measurements;
mod reload;
mod remote;
mod reproduce;
mod retention;
mod serve;
mod simulate;
mod supervisor;
mod token;
mod train;
mod update;

use std::future::Future;
use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};

use crate::config::{Config, Flags, HttpFlags, DEFAULT_FILE};
use crate::telemetry;

/// Watches structures through their natural frequencies.
#[derive(Debug, Parser)]
#[command(name = "modalwatch", version, about)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Run the service.
    Serve(ServeArgs),
    /// Start the service, post the paper's case 1 to it and print what it answers.
    Demo(demo::DemoArgs),
    /// Train the baseline of a structure.
    Train(train::TrainArgs),
    /// Measure whether a trained baseline is as sure as it should be.
    Calibrate(calibrate::CalibrateArgs),
    /// Simulate the alarm charts of a structure.
    DesignAlarm(design_alarm::DesignAlarmArgs),
    /// Simulate measurements of a structure as CSV.
    Simulate(simulate::SimulateArgs),
    /// Assess measurements without a service.
    Assess(assess::AssessArgs),
    /// Find mean and spread of the parameters behind measurements, by one of three methods.
    Update(update::UpdateArgs),
    /// Run both cases of the paper by all methods and write a report beside its figures.
    Reproduce(reproduce::ReproduceArgs),
    /// Find what the simulation gets wrong, name the cause and measure what naming it gains.
    Diagnose(diagnose::DiagnoseArgs),
    /// Diagnose, write the causes into a new version of the structure, and train its baseline.
    Extend(diagnose::ExtendArgs),
    /// Look at the configuration.
    Config {
        #[command(subcommand)]
        what: ConfigCommand,
    },
    /// Make, list, revoke and rotate tokens while the service is stopped.
    Token(token::TokenArgs),
    /// Ask a running service whether it is ready; exit status 0 when it is.
    Healthcheck(healthcheck::HealthcheckArgs),
    /// Look at everything the service needs and say what is wrong; exit status 1 when something is.
    Doctor(doctor::DoctorArgs),
    /// Copy the database into a folder, checked, while the service runs or not.
    Backup(backup::BackupArgs),
    /// Put the database of a backup into a data folder.
    Restore(backup::RestoreArgs),
    /// Write one structure with its measurements, states and baselines into a file for another installation.
    Export(archive::ExportArgs),
    /// Take such a file.
    Import(archive::ImportArgs),
    /// Say which batches are older than asked to keep, or delete them.
    Retention(retention::RetentionArgs),
}

#[derive(Debug, Subcommand)]
enum ConfigCommand {
    /// Print the configuration in force, as a file; --default prints the commented defaults.
    Print {
        /// The commented defaults.
        #[arg(long)]
        default: bool,
        #[command(flatten)]
        config: ServeArgs,
    },
}

/// Where the service listens and keeps its data; each has a default.
#[derive(Debug, Args)]
pub struct ServeArgs {
    /// Address and port; port 0 takes a free one [default: 127.0.0.1:8080]
    #[arg(long)]
    listen: Option<String>,
    /// Folder of the database [default: modalwatch-data]
    #[arg(long)]
    data_dir: Option<PathBuf>,
    /// Folder of your own structures and trained baselines; the shipped ones are inside the program
    #[arg(long)]
    models: Option<PathBuf>,
    /// Configuration file (TOML)
    #[arg(long)]
    config: Option<PathBuf>,
}

impl ServeArgs {
    fn flags(&self) -> Flags {
        Flags {
            data_dir: self.data_dir.clone(),
            models_dir: self.models.clone(),
            http: HttpFlags { listen: self.listen.clone() },
        }
    }

    fn read(&self) -> Result<Config, crate::config::Error> {
        Config::read(self.config.as_deref(), &self.flags())
    }
}

/// Runs the command of the arguments.
///
/// # Errors
/// Whatever stopped the command, with its chain of causes.
pub fn run() -> anyhow::Result<()> {
    match Cli::parse().command {
        Command::Serve(args) => {
            let config = args.read()?;
            let (log, traces) = telemetry::start(&config.log).map_err(anyhow::Error::msg)?;
            let reloading = reload::Reloading { file: args.config.clone(), flags: args.flags(), log };
            let served = block_on(serve::serve(config, reloading));
            traces.end();
            served
        }
        Command::Demo(args) => block_on(demo::demo(args)),
        Command::Train(args) => train::train(&args),
        Command::Simulate(args) => simulate::simulate(&args),
        Command::Assess(args) => assess::assess(&args),
        Command::Update(args) => update::update(&args),
        Command::Reproduce(args) => reproduce::reproduce(&args),
        Command::Diagnose(args) => diagnose::diagnose(&args),
        Command::Extend(args) => diagnose::extend(&args),
        Command::Calibrate(args) => calibrate::calibrate(&args),
        Command::DesignAlarm(args) => design_alarm::design_alarm(&args),
        Command::Config { what: ConfigCommand::Print { default: true, .. } } => {
            print!("{DEFAULT_FILE}");
            Ok(())
        }
        Command::Config { what: ConfigCommand::Print { config, .. } } => {
            print!("{}", toml::to_string(&config.read()?)?);
            Ok(())
        }
        Command::Token(args) => block_on(token::token(args)),
        Command::Healthcheck(args) => block_on(healthcheck::healthcheck(&args)),
        Command::Doctor(args) => block_on(doctor::doctor(&args)),
        Command::Backup(args) => block_on(backup::backup(&args)),
        Command::Restore(args) => block_on(backup::restore(&args)),
        Command::Export(args) => block_on(archive::export(&args)),
        Command::Import(args) => block_on(archive::import(&args)),
        Command::Retention(args) => block_on(retention::retention(&args)),
    }
}

fn block_on(future: impl Future<Output = anyhow::Result<()>>) -> anyhow::Result<()> {
    tokio::runtime::Builder::new_multi_thread().enable_all().build()?.block_on(future)
}

/// Turns the settings a person gives as `name=a,b` into name and numbers.
fn named_numbers(text: &str, count: usize, shape: &str) -> Result<(String, Vec<f64>), String> {
    let wrong = || format!("{text:?} should read {shape}");
    let (name, numbers) = text.split_once('=').ok_or_else(wrong)?;
    let numbers = numbers.split(',').map(|n| n.trim().parse().map_err(|_| wrong())).collect::<Result<Vec<f64>, _>>()?;
    if numbers.len() != count {
        return Err(wrong());
    }
    Ok((name.trim().to_owned(), numbers))
}

/// Writes a file beside its place and moves it there, so that nobody ever reads half of it.
fn write_whole(path: &std::path::Path, bytes: &[u8]) -> anyhow::Result<()> {
    use anyhow::Context as _;
    use std::io::Write as _;
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(std::path::Path::new("."));
    let place = || format!("cannot write {}", path.display());
    std::fs::create_dir_all(folder).with_context(place)?;
    let mut file = tempfile::NamedTempFile::new_in(folder).with_context(place)?;
    file.write_all(bytes).with_context(place)?;
    file.as_file().sync_all().with_context(place)?;
    // A temporary file is readable by its owner only; a result should be as readable as any other.
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt as _;
        file.as_file().set_permissions(std::fs::Permissions::from_mode(0o644)).with_context(place)?;
    }
    file.persist(path).with_context(place)?;
    Ok(())
}

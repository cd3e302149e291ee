//! The command line: the arguments, and one function per command.

mod archive;
mod assess;
mod backup;
mod calibrate;
mod check;
mod demo;
mod design_alarm;
mod design_process;
mod diagnose;
mod doctor;
mod download;
mod healthcheck;
mod measurements;
mod migrate;
mod model;
mod new;
mod next;
mod node;
mod output;
mod parameter;
mod post;
mod recorder;
mod rehearsal;
mod reload;
mod remote;
mod report;
mod reproduce;
mod retention;
mod serve;
mod simulate;
mod supervisor;
mod tables;
mod token;
mod train;
mod training;
mod update;
mod working;

use std::future::Future;
use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Parser, Subcommand};

use crate::config::{Config, Flags, HttpFlags, DEFAULT_FILE};
use crate::telemetry;

/// Monitors structures by their natural frequencies.
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
    /// Start a service, post case 1 of the paper to it and print the results.
    Demo(demo::DemoArgs),
    /// Write a structure file of masses and springs; asks for what the flags do not give.
    New(new::NewArgs),
    /// Show a structure before anything is trained: parts, modes, sensitivities, what its modes can identify, a drawing.
    Check(check::CheckArgs),
    /// Train the model of a structure.
    Train(train::TrainArgs),
    /// Check the calibration of a trained model: whether its posteriors have the right width.
    Calibrate(calibrate::CalibrateArgs),
    /// Simulate the alarm charts of a structure: false alarms, delay and detectable damage.
    DesignAlarm(design_alarm::DesignAlarmArgs),
    /// Simulate measurements of a structure, also with seasons, trends, a loss from a date, missing modes and outliers.
    Simulate(simulate::SimulateArgs),
    /// Assess measurements without a service.
    Assess(assess::AssessArgs),
    /// Post a table of measurements to a running service, which cuts it into batches by day, hour or pause.
    Post(post::PostArgs),
    /// Estimate mean and standard deviation of the parameters from measurements, by one of three methods.
    Update(update::UpdateArgs),
    /// Run both cases of the paper by all methods and write a report that compares the results with its figures.
    Reproduce(reproduce::ReproduceArgs),
    /// Find the effects that a simulation lacks, and measure how much they improve its predictions.
    Diagnose(diagnose::DiagnoseArgs),
    /// Diagnose, add the causes to a new version of the structure, and train its model.
    Extend(diagnose::ExtendArgs),
    /// Write the condition report of a structure, as a page made for print.
    Report(report::ReportArgs),
    /// Print the configuration.
    Config {
        #[command(subcommand)]
        what: ConfigCommand,
    },
    /// Create, list, revoke and rotate tokens while the service is stopped.
    Token(token::TokenArgs),
    /// Check whether a running service is ready; the exit status is 0 if it is.
    Healthcheck(healthcheck::HealthcheckArgs),
    /// Check everything the service needs and suggest remedies; the exit status is 1 if a check fails.
    Doctor(doctor::DoctorArgs),
    /// Copy the database to a folder and verify the copy, while the service is running or stopped.
    Backup(backup::BackupArgs),
    /// Restore the database of a backup to a data folder.
    Restore(backup::RestoreArgs),
    /// Make or change the schema of a PostgreSQL database, or move everything that is stored between it and a data folder.
    Migrate(migrate::MigrateArgs),
    /// Write one structure with its measurements, references and trained models to a file for another installation.
    Export(archive::ExportArgs),
    /// Read a file that `export` wrote.
    Import(archive::ImportArgs),
    /// List or delete the batches that are older than the retention period.
    Retention(retention::RetentionArgs),
}

#[derive(Debug, Subcommand)]
enum ConfigCommand {
    /// Print the configuration in force as TOML; --default prints the commented defaults.
    Print {
        /// Print the commented defaults
        #[arg(long)]
        default: bool,
        #[command(flatten)]
        config: ServeArgs,
    },
}

/// Settings of the service that have a flag.
#[derive(Debug, Args)]
pub struct ServeArgs {
    /// Address and port; port 0 chooses a free port [default: 127.0.0.1:8080]
    #[arg(long)]
    listen: Option<String>,
    /// Folder of the database [default: modalwatch-data]
    #[arg(long)]
    data_dir: Option<PathBuf>,
    /// Folder of your own structures and trained models, in addition to those shipped with the program
    #[arg(long)]
    models: Option<PathBuf>,
    /// Configuration file (TOML)
    #[arg(long)]
    config: Option<PathBuf>,
    /// What this process does for a PostgreSQL database: api, worker, or both [default: api,worker]
    #[arg(long)]
    roles: Option<String>,
}

impl ServeArgs {
    fn flags(&self) -> Flags {
        Flags {
            data_dir: self.data_dir.clone(),
            models_dir: self.models.clone(),
            http: HttpFlags { listen: self.listen.clone() },
            roles: self.roles.clone(),
        }
    }

    fn read(&self) -> Result<Config, crate::config::Error> {
        Config::read(self.config.as_deref(), &self.flags())
    }
}

/// Runs the command that the arguments of the program name.
///
/// # Errors
/// The error of the command, with its chain of causes.
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
        Command::New(args) => new::new(&args),
        Command::Check(args) => check::check(&args),
        Command::Train(args) => train::train(&args),
        Command::Simulate(args) => simulate::simulate(&args),
        Command::Assess(args) => assess::assess(&args),
        Command::Post(args) => block_on(post::post(&args)),
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
        Command::Migrate(args) => block_on(migrate::migrate(&args)),
        Command::Export(args) => block_on(archive::export(&args)),
        Command::Import(args) => block_on(archive::import(&args)),
        Command::Report(args) => block_on(report::report(&args)),
        Command::Retention(args) => block_on(retention::retention(&args)),
    }
}

/// Time that computations have to end after their command has ended. A job between two of its steps is left behind: the process ends
/// without it, and what it computes is not stored.
const LAST_STEPS: Duration = Duration::from_millis(500);

fn block_on(future: impl Future<Output = anyhow::Result<()>>) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let outcome = runtime.block_on(future);
    // Without a limit, the runtime would wait for the thread of a training.
    runtime.shutdown_timeout(LAST_STEPS);
    outcome
}

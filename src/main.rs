//! The program: sets up the threads and runs the command of `cli`.

use std::process::ExitCode;

// The allocator of the C library keeps the memory of large request bodies for the thread that read them, and does not return it.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    end_quietly_without_a_reader();
    let cores = core_affinity::get_core_ids().unwrap_or_default();
    let keep_to_core = move |thread: usize| {
        // Only if the pool uses all cores: with fewer threads, several programs would be pinned to the same cores.
        if rayon::current_num_threads() == cores.len() {
            core_affinity::set_for_current(cores[thread]);
        }
    };
    // Without pinning, the scheduler often starts two threads of a short computation on the same core and leaves them there for
    // milliseconds, while another core is idle.
    let _ = rayon::ThreadPoolBuilder::new().start_handler(keep_to_core).build_global();
    // candle splits even small matrix products over several threads, which is slower at our sizes. It reads this variable at its
    // first product; the pool above has been built before.
    if std::env::var_os("RAYON_NUM_THREADS").is_none() {
        std::env::set_var("RAYON_NUM_THREADS", "1");
    }
    match modalwatch::cli::run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("modalwatch: {}", message(&error));
            ExitCode::FAILURE
        }
    }
}

/// Ends the program when its output cannot be written, instead of a panic of `println!`: silently with the status of a command whose
/// reader has left, as `head` does, otherwise with the cause, such as a full disk.
fn end_quietly_without_a_reader() {
    /// 128 + the number of the signal SIGPIPE.
    const READER_LEFT: i32 = 141;
    let usual = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        let text = panic.payload_as_str().unwrap_or_default();
        if let Some(cause) = text.strip_prefix("failed printing to stdout: ") {
            if cause.contains("Broken pipe") {
                std::process::exit(READER_LEFT);
            }
            eprintln!("modalwatch: the output cannot be written: {cause}");
            std::process::exit(1);
        }
        usual(panic);
    }));
}

/// The chain of causes in one line, without causes that the messages before them already contain.
fn message(error: &anyhow::Error) -> String {
    error.chain().map(ToString::to_string).fold(String::new(), |text, cause| match text.as_str() {
        "" => cause,
        text if text.contains(&cause) => text.to_owned(),
        text => format!("{text}: {cause}"),
    })
}

//! The program: hands its arguments to `cli`.

use std::process::ExitCode;

// The C library's allocator keeps the memory of large bodies for the thread that read them, and ever more of it.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    // candle splits even tiny products over its own thread pool, which costs more than it gains at our sizes. It reads this
    // variable at its first product; our own pool is made before.
    let cores = core_affinity::get_core_ids().unwrap_or_default();
    let keep_to_core = move |thread: usize| {
        // Only where all the cores are ours: with a quota of some, several programs would keep to the same.
        if rayon::current_num_threads() == cores.len() {
            core_affinity::set_for_current(cores[thread]);
        }
    };
    // Left to the scheduler, both threads of a computation of milliseconds are often woken on the core of the one that wakes the
    // other, and stay there until its next tick while another core is idle.
    let _ = rayon::ThreadPoolBuilder::new().start_handler(keep_to_core).build_global();
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

/// The chain of causes, without those whose text the one above them quotes already.
fn message(error: &anyhow::Error) -> String {
    error.chain().map(ToString::to_string).fold(String::new(), |said, cause| match said.as_str() {
        "" => cause,
        said if said.contains(&cause) => said.to_owned(),
        said => format!("{said}: {cause}"),
    })
}

//! What must be equal of two processes so that they compute the same assessments, bit for bit.

use std::sync::LazyLock;

use crate::quantity::Digest;

/// Names the program and what of its machine its numbers depend on: the version, the bytes of the program, the vector instructions that it
/// detects at run time, and the elementary functions of the system. Reading the program takes a moment at the first call.
pub(super) fn program() -> &'static str {
    static PROGRAM: LazyLock<String> = LazyLock::new(|| {
        let bytes = match std::fs::read(running()) {
            Ok(bytes) => shortened(&Digest::of_file(&bytes)),
            // Equal to no other process: nothing is shared.
            Err(_) => uuid::Uuid::now_v7().to_string(),
        };
        let version = env!("CARGO_PKG_VERSION");
        format!("{version} {bytes} {} {}", vector_instructions(), elementary_functions())
    });
    &PROGRAM
}

/// The file that this process runs, also where an upgrade has replaced it meanwhile.
fn running() -> std::path::PathBuf {
    if cfg!(target_os = "linux") {
        "/proc/self/exe".into()
    } else {
        std::env::current_exe().unwrap_or_default()
    }
}

fn vector_instructions() -> String {
    let mut found = vec![std::env::consts::ARCH];
    #[cfg(target_arch = "x86_64")]
    for (name, detected) in [
        ("fma", std::is_x86_feature_detected!("fma")),
        ("avx2", std::is_x86_feature_detected!("avx2")),
        ("avx512f", std::is_x86_feature_detected!("avx512f")),
        ("avx512vl", std::is_x86_feature_detected!("avx512vl")),
        ("avx512dq", std::is_x86_feature_detected!("avx512dq")),
    ] {
        if detected {
            found.push(name);
        }
    }
    found.join("+")
}

/// Digest of some values of the functions that the program takes from the system, whose last bits differ between versions of the C library.
fn elementary_functions() -> String {
    let functions: [fn(f64) -> f64; 12] = [
        f64::exp,
        f64::exp_m1,
        f64::ln,
        f64::ln_1p,
        f64::sin,
        f64::cos,
        f64::tan,
        f64::atan,
        f64::tanh,
        f64::cbrt,
        |x| x.powf(0.731),
        |x| (x.hypot(0.37)).atan2(x),
    ];
    let values = (1..=64).map(|i| f64::from(i) * 0.173_205_080_756_887_7);
    let bytes: Vec<u8> =
        values.flat_map(|x| functions.iter().flat_map(move |f| f(std::hint::black_box(x)).to_le_bytes())).collect();
    shortened(&Digest::of_file(&bytes))
}

fn shortened(digest: &Digest) -> String {
    digest.as_str().chars().take(16).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_is_always_the_same_program() {
        assert_eq!(program(), program());
        assert_eq!(elementary_functions(), elementary_functions());
        assert_eq!(program().split(' ').count(), 4, "{}", program());
    }
}

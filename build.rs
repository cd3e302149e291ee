//! The baselines of `models/` and the files of `migrations/` are built into the program: a new file must build it again.

fn main() {
    println!("cargo:rerun-if-changed=models");
    println!("cargo:rerun-if-changed=migrations");
}

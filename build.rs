//! The files of `migrations/` and the pages of `docs/` are embedded in the program, which must be built again when one of them is
//! added or changed.

fn main() {
    println!("cargo:rerun-if-changed=docs");
    println!("cargo:rerun-if-changed=migrations");
}

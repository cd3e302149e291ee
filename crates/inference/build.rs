//! The models of `models/` are embedded in this crate, which must be built again when one of them is added or changed.

fn main() {
    println!("cargo:rerun-if-changed=../../models");
}

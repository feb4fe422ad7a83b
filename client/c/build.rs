//! How the shared library is linked: with a name that programs find it by when they start, and without
//! tables for debuggers.

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    if std::env::var("CARGO_CFG_TARGET_OS").is_ok_and(|os| os == "linux") {
        println!("cargo:rustc-cdylib-link-arg=-Wl,-soname,libplantd.so.0");
        println!("cargo:rustc-cdylib-link-arg=-Wl,--strip-debug");
    }
}

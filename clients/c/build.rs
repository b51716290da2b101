//! Gives the shared library its soname, with the number of `EW_ABI`, and hides the symbols of other libraries.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rustc-cdylib-link-arg=-Wl,-soname,libemberwatch.so.1");
    println!("cargo::rustc-cdylib-link-arg=-Wl,--exclude-libs,ALL");
}

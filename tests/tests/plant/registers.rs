//! What is done in registers is written out where it is done.

use std::process::Command;

/// A function of registers of eight or four numbers that is called hands them over through memory, compiled for any
/// processor: kernels in which one was took ten times as long, to the same bits.
#[test]
fn no_function_of_registers_is_called() {
    let nm = Command::new("nm").arg(plantd_tests::example("speed")).output();
    let symbols = nm.expect("nm, which comes with the C compiler").stdout;
    let symbols = String::from_utf8_lossy(&symbols);
    assert!(symbols.contains("in_eights"), "there are kernels");
    let called: Vec<&str> =
        symbols.lines().filter(|name| name.contains("core_arch") && name.contains("_pd")).collect();
    assert!(called.is_empty(), "{called:#?}");
}

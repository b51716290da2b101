//! The C interface: its header compiles as C and C++ in strict modes; its examples and the programs in
//! `clients/c/tests/programs` run, on a server and in the process.

use std::path::{Path, PathBuf};
use std::process::Command;
use tests::harness::{
    Ended, Folder, LIMIT, PATIENCE, Program, SERVER, Server, eventually, new_instance,
    program_path, repository, status,
};

const SANITIZERS: &str = "-fsanitize=address,undefined -fno-sanitize-recover=undefined";

/// Returns the library, which cargo builds for these tests as for any dependency.
fn library() -> PathBuf {
    let test = std::env::current_exe().expect("this program's path");
    test.with_file_name("libemberwatch.so")
}

/// Runs the compiler for a source file of `clients/c` with all warnings as errors.
fn compile(source: &str, before: &str, after: &str) {
    let compiler = if source.ends_with(".cpp") || before.contains("c++") {
        "c++"
    } else {
        "cc"
    };
    let folder = repository().join("clients/c");
    let compiled = Command::new(compiler)
        .args(["-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O1", "-g"])
        .arg("-I")
        .arg(folder.join("include"))
        .args(before.split_whitespace())
        .arg(folder.join(source))
        .args(after.split_whitespace())
        .output()
        .expect("a compiler; scripts/setup installs it");
    let said = String::from_utf8_lossy(&compiled.stderr);
    assert!(compiled.status.success(), "{compiler} {source}: {said}");
}

/// Returns the library's path below a folder, where it has its soname.
fn link(folder: &Folder) -> String {
    let link = folder.path("libemberwatch.so.1");
    if !link.exists() {
        std::os::unix::fs::symlink(library(), &link).expect("a link");
    }
    folder.word("libemberwatch.so.1")
}

/// Compiles a program with the library, and starts it.
fn start(folder: &Folder, source: &str, flags: &str, arguments: &[&str]) -> Program {
    let name = Path::new(source).file_stem().expect("a name");
    let program = folder.path(&name.to_string_lossy());
    let links = format!(
        "{} -Wl,-rpath,{} -ldl -pthread",
        link(folder),
        folder.word("")
    );
    compile(source, flags, &format!("-o {} {links}", program.display()));
    Program::start_at(&program, arguments)
}

fn run(folder: &Folder, source: &str, flags: &str, arguments: &[&str]) -> Ended {
    start(folder, source, flags, arguments).wait(LIMIT).check(0)
}

fn run_in_process(flags: &str) {
    let ended = run(
        &Folder::default(),
        "tests/programs/in_process.c",
        flags,
        &[],
    );
    ended.check_prints("pipe as model");
}

fn run_attached(flags: &str) {
    let (folder, instance) = (Folder::default(), new_instance());
    let server = program_path(SERVER);
    let (server, place) = (server.display().to_string(), folder.word(""));
    let arguments = [instance.name(), &server, &place];
    let ended = run(&folder, "tests/programs/attached.c", flags, &arguments);
    ended.check_prints("killed server");
}

#[test]
fn the_header_compiles_as_c_and_cpp_of_all_years() {
    for standard in [
        "c99", "c11", "c17", "c2x", "c++11", "c++14", "c++17", "c++20",
    ] {
        let flags = format!("-std={standard} -fsyntax-only");
        let language = if standard.contains("++") { "c++" } else { "c" };
        compile(
            "include/emberwatch.h",
            &format!("-x {language} {flags}"),
            "",
        );
    }
}

#[test]
fn worlds_in_the_process_refuse_fly_fork_and_end() {
    run_in_process("-std=gnu11");
}

#[test]
fn a_server_and_its_failures_have_the_documented_codes() {
    run_attached("-std=gnu11");
}

#[test]
fn the_examples_fly_in_the_process_and_on_a_server() {
    let (folder, server) = (Folder::default(), Server::start("--seed 7"));
    let instance = [server.instance.name()];
    for (source, flags) in [
        ("examples/random.c", "-std=c99"),
        ("examples/random.cpp", "-std=c++17"),
    ] {
        let own = run(&folder, source, flags, &[]);
        let served = run(&folder, source, flags, &instance);
        own.check_prints("mean reward ");
        assert_eq!(own.stdout, served.stdout, "{source}");
    }
}

#[test]
fn the_node_flies_at_10_hz_beside_a_late_teammate_and_survives_a_restart() {
    let (folder, instance) = (Folder::default(), new_instance());
    let flags = "--robots 2 --deadline-millis 20 --burn-in 0";
    let first = Server::start_on(&instance, flags);
    let arguments = [instance.name(), "4"];
    let node = start(&folder, "examples/node.c", "-std=c99", &arguments);
    let has_flown = || status(&instance).is_ok_and(|status| status.n_steps > 2);
    assert!(eventually(PATIENCE, has_flown), "{}", node.stderr());
    first.kill();
    let _second = Server::start_on(&instance, flags);
    let ended = node.ends(0);
    ended.check_prints("after 40 steps").check_says("is gone");
}

#[test]
#[ignore = "needs Go"]
fn the_example_in_go_flies_in_the_process() {
    let (folder, example) = (Folder::default(), "clients/c/examples/random.go");
    let library = format!("{} -Wl,-rpath,{}", link(&folder), folder.word(""));
    let include = repository().join("clients/c/include");
    let program = folder.word("random_go");
    let built = Command::new("go")
        .args(["build", "-o", &program])
        .arg(repository().join(example))
        .env("CGO_CFLAGS", format!("-I{}", include.display()))
        .env("CGO_LDFLAGS", library)
        .env("CGO_LDFLAGS_ALLOW", ".*")
        .output()
        .expect("Go; scripts/test --all installs it");
    let said = String::from_utf8_lossy(&built.stderr);
    assert!(built.status.success(), "{said}");
    let ended = Program::start_at(Path::new(&program), &[]).wait(LIMIT);
    ended.check(0).check_prints("mean reward ");
}

#[test]
#[ignore = "compiles with sanitizers"]
fn the_sanitizers_find_nothing() {
    run_in_process(&format!("-std=gnu11 {SANITIZERS}"));
    run_attached(&format!("-std=gnu11 {SANITIZERS}"));
}

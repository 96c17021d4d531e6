//! Every input of the corpora, without libFuzzer: none fails, and none of the targets refuses all of its own.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use popgym_fuzz::TARGETS;

fn folder(of: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(of)
}

/// The names in a folder, without their extension.
fn names(folder: &Path) -> BTreeSet<String> {
    let entries = std::fs::read_dir(folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display()));
    entries.map(|entry| entry.unwrap().path().file_stem().unwrap().to_string_lossy().into_owned()).collect()
}

/// Runs the corpus of one target.
fn run(name: &str) {
    let (_, target) = TARGETS.into_iter().find(|target| target.0 == name).unwrap();
    let mut accepted = 0;
    let entries: Vec<_> = std::fs::read_dir(folder("corpus").join(name)).unwrap().collect();
    assert!(!entries.is_empty());
    for entry in entries {
        let path = entry.unwrap().path();
        // Shown if it is the last.
        println!("{}", path.display());
        accepted += usize::from(target(&std::fs::read(&path).unwrap()));
    }
    assert!(accepted > 0, "every input is refused");
}

#[test]
fn wire() {
    run("wire");
}

#[test]
fn weights() {
    run("weights");
}

#[test]
fn checkpoint() {
    run("checkpoint");
}

#[test]
fn configuration() {
    run("configuration");
}

#[test]
fn study() {
    run("study");
}

#[test]
fn recording() {
    run("recording");
}

#[test]
fn every_target_has_a_program_and_a_corpus() {
    let targets: BTreeSet<String> = TARGETS.iter().map(|target| target.0.to_owned()).collect();
    assert_eq!(names(&folder("fuzz_targets")), targets);
    assert_eq!(names(&folder("corpus")), targets);
}

//! Finds run directories, and reads them.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use popgym_envs::Registry;
use popgym_models::memory;

use super::labels::differing_keys;
use super::paper::place;
use super::run::Run;
use crate::run_dir::RunDir;

/// Characters of an error that a note quotes, at most.
const ERROR: usize = 300;

/// What is worth knowing about a directory that is not in the figures, or not as it was meant to be.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Note {
    /// The directory.
    pub dir: PathBuf,
    /// What about it.
    pub text: String,
}

/// `notes` by what they say: each text, and the directories that it is about.
pub fn by_text(notes: &[Note]) -> Vec<(&str, Vec<&Path>)> {
    let mut groups: Vec<(&str, Vec<&Path>)> = Vec::new();
    for note in notes {
        match groups.iter_mut().find(|(text, _)| *text == note.text) {
            Some((_, dirs)) => dirs.push(&note.dir),
            None => groups.push((&note.text, vec![&note.dir])),
        }
    }
    groups
}

/// The runs below some directories.
#[derive(Debug, Default)]
pub struct Collection {
    /// In order of environment, preset with what was changed of it, memory, seed.
    pub runs: Vec<Run>,
    /// What could not be read, counts no second time, or failed.
    pub notes: Vec<Note>,
}

/// Reads all runs in and below `dirs`; symbolic links are not followed.
///
/// # Errors
/// A directory that cannot be read, or without any run in it.
pub fn collect(dirs: &[PathBuf], envs: &Registry, memories: &memory::Registry) -> anyhow::Result<Collection> {
    let mut collection = Collection::default();
    let mut seen = BTreeSet::new();
    for dir in dirs {
        let found = find(dir, &mut collection.notes)?;
        anyhow::ensure!(
            !found.runs.is_empty() || !found.failures.is_empty(),
            "{} holds no run: a run directory has a config.toml, and there is none in it or below it",
            dir.display()
        );
        // Directories that were named may contain one another.
        let mut new = |path: &PathBuf| seen.insert(fs::canonicalize(path).unwrap_or_else(|_| path.clone()));
        for dir in found.runs.into_iter().filter(&mut new) {
            match Run::read(&dir, envs, memories) {
                Ok(run) => collection.runs.push(run),
                Err(error) => collection.notes.push(Note { dir, text: format!("left out: {error:#}") }),
            }
        }
        let failures: Vec<PathBuf> = found.failures.into_iter().filter(&mut new).collect();
        collection.notes.extend(failures.iter().filter_map(|path| failed(path, &collection.runs)));
    }
    collection.once_each();
    Ok(collection)
}

impl Collection {
    /// Sorts, and keeps of several runs of the same environment, configuration, memory and seed the longest.
    fn once_each(&mut self) {
        // The longest first; the sort is stable, so of equals the one that was found first.
        self.runs.sort_by(|a, b| {
            let key = |run: &Run| {
                (run.task.order, run.task.preset.clone(), place(&run.paper_memory), run.memory.clone(), run.seed)
            };
            key(a).cmp(&key(b)).then(b.steps.cmp(&a.steps))
        });
        let mut kept: Vec<Run> = Vec::new();
        for run in std::mem::take(&mut self.runs) {
            let same =
                |last: &&Run| last.task.key() == run.task.key() && last.memory == run.memory && last.seed == run.seed;
            if let Some(last) = kept.last().filter(same) {
                let keys = differing_keys(&[&last.config, &run.config]);
                let differs =
                    if keys.is_empty() { String::new() } else { format!("; it differs in {}", keys.join(", ")) };
                let text = format!(
                    "left out: {} is of the same environment, configuration, memory and seed, and not shorter{differs}",
                    last.dir.display()
                );
                self.notes.push(Note { dir: run.dir, text });
            } else {
                kept.push(run);
            }
        }
        self.runs = kept;
    }
}

/// What the file `NAME.failures` says of the trial NAME of a study, unless its run has come to its end.
fn failed(path: &Path, runs: &[Run]) -> Option<Note> {
    #[derive(serde::Deserialize)]
    struct Failure {
        error: String,
    }
    let dir = path.with_extension("");
    let real = fs::canonicalize(&dir).ok();
    if real.is_some() && runs.iter().any(|run| run.complete() && fs::canonicalize(&run.dir).ok() == real) {
        return None;
    }
    let bytes = fs::read(path).unwrap_or_default();
    let text = String::from_utf8_lossy(&bytes);
    // A crash may have torn a line.
    let failures: Vec<Failure> = text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
    let last = failures.last()?.error.trim();
    let times = if failures.len() == 1 { "once".to_owned() } else { format!("{} times", failures.len()) };
    Some(Note { dir, text: format!("failed {times}: {}", last.chars().take(ERROR).collect::<String>()) })
}

/// What is in a directory and below it, in order of the paths.
#[derive(Default)]
struct Found {
    /// Run directories.
    runs: Vec<PathBuf>,
    /// Files beside them that tell how trials of a study failed.
    failures: Vec<PathBuf>,
}

/// What is in and below `root`. What is inside a run is not looked at.
fn find(root: &Path, notes: &mut Vec<Note>) -> anyhow::Result<Found> {
    let children = |dir: &Path| -> std::io::Result<(Vec<PathBuf>, Vec<PathBuf>)> {
        let (mut dirs, mut failures) = (Vec::new(), Vec::new());
        for entry in fs::read_dir(dir)? {
            let entry = entry?;
            let (kind, path) = (entry.file_type()?, entry.path());
            if kind.is_dir() {
                dirs.push(path);
            } else if kind.is_file() && path.extension().is_some_and(|extension| extension == "failures") {
                failures.push(path);
            }
        }
        dirs.sort_by(|a, b| b.cmp(a));
        failures.sort();
        Ok((dirs, failures))
    };
    let mut found = Found::default();
    let mut open = vec![root.to_owned()];
    while let Some(dir) = open.pop() {
        if RunDir::holds_run(&dir) {
            found.runs.push(dir);
            continue;
        }
        match children(&dir) {
            Ok((dirs, failures)) => {
                open.extend(dirs);
                found.failures.extend(failures);
            }
            Err(error) if dir == root => anyhow::bail!("cannot read {}: {error}", root.display()),
            Err(error) => notes.push(Note { dir, text: format!("cannot be read: {error}") }),
        }
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::super::samples::{RunFiles, collected};
    use super::*;

    #[test]
    fn runs_at_any_depth_once_each() {
        let root = tempfile::tempdir().unwrap();
        let dir = |name: &str| root.path().join(name);
        let epochs = [(70_000, 200, 0.5)];
        RunFiles { seed: 1, ..RunFiles::default() }.write(&dir("study/trials/0001"), &epochs);
        RunFiles::default().write(&dir("study/trials/0000"), &epochs);
        RunFiles { memory: "mlp", ..RunFiles::default() }.write(&dir("alone"), &epochs);
        fs::create_dir(dir("alone/checkpoints")).unwrap();
        fs::write(dir("alone/checkpoints/config.toml"), "").unwrap();
        std::os::unix::fs::symlink(dir("alone"), dir("study/link")).unwrap();
        let found = collected(&[root.path(), &dir("study"), &dir("alone")]).unwrap();
        let runs: Vec<_> = found.runs.iter().map(|run| (run.memory.as_str(), run.seed)).collect();
        assert_eq!(runs, [("mlp", 0), ("gru", 0), ("gru", 1)]);
        assert_eq!(found.notes, []);
    }

    #[test]
    fn notes_that_say_the_same_are_one() {
        let note = |dir: &str, text: &str| Note { dir: dir.into(), text: text.into() };
        let notes = [note("a", "x"), note("b", "y"), note("c", "x")];
        let (a, b, c) = (Path::new("a"), Path::new("b"), Path::new("c"));
        assert_eq!(by_text(&notes), [("x", vec![a, c]), ("y", vec![b])]);
    }

    #[test]
    fn the_longest_of_the_same_seed() {
        let root = tempfile::tempdir().unwrap();
        RunFiles::default().write(&root.path().join("a"), &[(70_000, 200, 0.5)]);
        RunFiles { keys: "threads = 3\n", ..RunFiles::default() }.write(&root.path().join("b"), &[(80_000, 200, 0.25)]);
        RunFiles { preset: "paper", ..RunFiles::default() }.write(&root.path().join("c"), &[(60_000, 200, 0.25)]);
        let found = collected(&[root.path()]).unwrap();
        let runs: Vec<_> = found.runs.iter().map(|run| (run.task.preset.as_str(), run.steps)).collect();
        assert_eq!(runs, [("paper", 60_000), ("quick", 80_000)]);
        assert_eq!(found.notes.len(), 1);
        assert_eq!(found.notes[0].dir, root.path().join("a"));
        assert!(found.notes[0].text.ends_with("not shorter; it differs in steps, threads"), "{}", found.notes[0].text);
    }

    #[test]
    fn variants_of_a_preset_are_different_things() {
        let root = tempfile::tempdir().unwrap();
        // The first is the preset as it is.
        let variants: Vec<String> = (30..44).map(|i| format!("ppo.clip = 0.{i}\n")).collect();
        for (i, keys) in variants.iter().enumerate() {
            RunFiles { keys, ..RunFiles::default() }.write(&root.path().join(i.to_string()), &[(70_000, 200, 0.5)]);
        }
        let found = collected(&[root.path()]).unwrap();
        assert_eq!((found.runs.len(), found.notes.len()), (14, 0));
        let cells = super::super::cell::cells(found.runs).unwrap();
        assert_eq!(cells.len(), 14);
        assert_eq!((cells[0].task.preset.as_str(), cells[3].task.preset.as_str()), ("quick", "quick, clip 0.33"));
    }

    #[test]
    fn trials_that_failed_are_noted() {
        let root = tempfile::tempdir().unwrap();
        let dir = |name: &str| root.path().join("trials").join(name);
        let epochs = [(70_000, 200, 0.5)];
        RunFiles::default().write(&dir("done"), &epochs);
        RunFiles { seed: 1, stopped_by: "", budget: Some(80_000), ..RunFiles::default() }.write(&dir("begun"), &epochs);
        let line = |error: &str| format!("\n{{\"status\": \"exit status: 1\", \"error\": \"{error}\"}}\n");
        fs::write(dir("done.failures"), line("x")).unwrap();
        fs::write(dir("begun.failures"), line("no memory")).unwrap();
        // Bytes that are no text, and a torn line.
        let torn = [line("a").as_bytes(), b"\xff\xfe\n", line("b").as_bytes(), b"{\"status"].concat();
        fs::write(dir("never.failures"), torn).unwrap();
        fs::write(dir("empty.failures"), "").unwrap();
        let found = collected(&[root.path(), &dir("")]).unwrap();
        assert_eq!(found.runs.len(), 2);
        let note = |name: &str, text: &str| Note { dir: dir(name), text: text.into() };
        assert_eq!(found.notes, [note("begun", "failed once: no memory"), note("never", "failed 2 times: b")]);
        // A study without a single run is not without notes.
        fs::remove_dir_all(dir("done")).unwrap();
        fs::remove_dir_all(dir("begun")).unwrap();
        assert_eq!(collected(&[root.path()]).unwrap().notes.len(), 3);
    }

    #[test]
    fn bad_runs_are_noted_and_none_is_an_error() {
        let root = tempfile::tempdir().unwrap();
        RunFiles::default().write(&root.path().join("good"), &[(70_000, 200, 0.5)]);
        RunFiles::default().write(&root.path().join("half"), &[(70_000, 200, 0.5)]);
        fs::remove_file(root.path().join("half/metrics.csv")).unwrap();
        let found = collected(&[root.path()]).unwrap();
        assert_eq!(found.runs.len(), 1);
        let note = Note { dir: root.path().join("half"), text: "left out: metrics.csv is missing".into() };
        assert_eq!(found.notes, [note]);
        let empty = tempfile::tempdir().unwrap();
        for dir in [empty.path(), &empty.path().join("gone")] {
            let error = format!("{:#}", collected(&[root.path(), dir]).unwrap_err());
            assert!(error.contains(&dir.display().to_string()), "{error}");
        }
    }
}

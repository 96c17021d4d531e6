//! Finds run directories, and reads them.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use popgym_envs::Registry;
use popgym_models::memory;

use super::labels::differing_keys;
use super::run::Run;
use crate::run_dir::RunDir;

/// What is worth knowing about a directory that is not in the figures.
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
    /// In order of environment, preset, memory, seed.
    pub runs: Vec<Run>,
    /// What could not be read, or counts no second time.
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
            !found.is_empty(),
            "{} holds no run: a run directory has a config.toml, and there is none in it or below it",
            dir.display()
        );
        for dir in found {
            // Directories that were named may contain one another.
            if seen.insert(fs::canonicalize(&dir).unwrap_or_else(|_| dir.clone())) {
                match Run::read(&dir, envs, memories) {
                    Ok(run) => collection.runs.push(run),
                    Err(error) => collection.notes.push(Note { dir, text: format!("left out: {error:#}") }),
                }
            }
        }
    }
    collection.once_each();
    Ok(collection)
}

impl Collection {
    /// Sorts, and keeps of several runs of the same environment, preset, memory and seed the longest.
    fn once_each(&mut self) {
        // The longest first; the sort is stable, so of equals the one that was found first.
        self.runs.sort_by(|a, b| {
            let key = |run: &Run| (run.task.order, run.task.preset.clone(), place(run), run.memory.clone(), run.seed);
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
                    "left out: {} is of the same environment, preset, memory and seed, and not shorter{differs}",
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

/// Place of a run's memory in the paper's tables; others come last.
fn place(run: &Run) -> usize {
    let place = super::paper::MEMORIES.iter().position(|name| *name == run.paper_memory);
    place.unwrap_or(usize::MAX)
}

/// The run directories in and below `root`, in order of their paths. What is inside a run is not looked at.
fn find(root: &Path, notes: &mut Vec<Note>) -> anyhow::Result<Vec<PathBuf>> {
    let children = |dir: &Path| -> std::io::Result<Vec<PathBuf>> {
        let mut children = Vec::new();
        for entry in fs::read_dir(dir)? {
            let entry = entry?;
            if entry.file_type()?.is_dir() {
                children.push(entry.path());
            }
        }
        children.sort_by(|a, b| b.cmp(a));
        Ok(children)
    };
    let mut found = Vec::new();
    let mut open = vec![root.to_owned()];
    while let Some(dir) = open.pop() {
        if RunDir::holds_run(&dir) {
            found.push(dir);
            continue;
        }
        match children(&dir) {
            Ok(more) => open.extend(more),
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
        RunFiles { budget: 500_000, ..RunFiles::default() }.write(&root.path().join("b"), &[(80_000, 200, 0.25)]);
        RunFiles { preset: "paper", ..RunFiles::default() }.write(&root.path().join("c"), &[(60_000, 200, 0.25)]);
        let found = collected(&[root.path()]).unwrap();
        let runs: Vec<_> = found.runs.iter().map(|run| (run.task.preset.as_str(), run.steps)).collect();
        assert_eq!(runs, [("paper", 60_000), ("quick", 80_000)]);
        assert_eq!(found.notes.len(), 1);
        assert_eq!(found.notes[0].dir, root.path().join("a"));
        assert!(found.notes[0].text.ends_with("not shorter; it differs in steps"), "{}", found.notes[0].text);
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

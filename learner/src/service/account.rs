//! The account of a run, `events.jsonl`: who held which lease, which episodes came of it, and what was done with them. A line
//! an event, in the order in which the coordinator decided; `time` is in seconds since 1970.

use std::collections::BTreeSet;
use std::fs::{File, OpenOptions};
use std::io::{BufWriter, Read as _, Seek as _, SeekFrom, Write as _};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::Context as _;
use serde::Serialize;
use tracing::warn;

use super::Target;
use super::metrics;

/// A file that has grown beyond this many bytes becomes `events.1.jsonl`, in place of the one before, when the next epoch opens. A
/// line is some 100 bytes, and there are a few for each message of an actor: hours of work.
const LARGEST_FILE: u64 = 256 << 20;

/// What happened. Episodes are given as ranges of their numbers, `[first, last]`.
#[derive(Debug, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub(super) enum Entry<'a> {
    /// A learner began to serve this run, or a file; what an epoch had before that is not closed is void.
    Started { run: &'a str, build: &'a str, lag: u32 },
    /// An epoch can be sampled, with the weights of `version`. What came for it before is void.
    Opened { epoch: u64, version: u64, target: Target },
    /// An actor is ready.
    Joined { actor: &'a str, returned: bool },
    /// An actor has gone; `leases` of its leases are free again.
    Left { actor: &'a str, leases: usize, reason: &'a str },
    /// An actor got leases.
    Leased { epoch: u64, actor: &'a str, episodes: Vec<[u64; 2]> },
    /// Episodes came that were leased to this actor.
    Accepted { epoch: u64, version: u64, actor: &'a str, episodes: Vec<[u64; 2]> },
    /// Episodes came that nobody wanted, and were dropped.
    Refused { epoch: u64, version: u64, actor: &'a str, reason: &'a str, episodes: Vec<[u64; 2]> },
    /// The batch is complete: episodes `0..episodes`.
    Closed { epoch: u64, version: u64, episodes: u64, steps: u64, surplus_episodes: u64 },
    /// The run is complete.
    Finished { reason: &'a str },
}

#[derive(Serialize)]
struct Line<'a> {
    time: f64,
    #[serde(flatten)]
    entry: Entry<'a>,
}

/// Writes the account, or nothing where there is none to write.
#[derive(Debug, Default)]
pub(super) struct Account {
    /// `None`: the disk is full.
    open: Option<Open>,
    /// Where it is, and of which run with which lag. `None`: there is none to write.
    about: Option<(PathBuf, String, u32)>,
}

#[derive(Debug)]
struct Open {
    file: BufWriter<File>,
    bytes: u64,
}

impl Account {
    /// Continues the account in `path`, of a run and its lag.
    pub(super) fn open(path: &Path, run: &str, lag: u32) -> anyhow::Result<Self> {
        let open = Open::resume(path).with_context(|| format!("cannot write {}", path.display()))?;
        let mut account = Self { open: Some(open), about: Some((path.to_owned(), run.to_owned(), lag)) };
        account.start();
        Ok(account)
    }

    fn start(&mut self) {
        if let Some((_, run, lag)) = self.about.clone() {
            self.write(Entry::Started { run: &run, build: env!("CARGO_PKG_VERSION"), lag });
        }
    }

    /// Between two epochs: begins a new file where this one is large, and goes on where the disk was full. True if it did:
    /// then what is the case has to be told anew, so that each file can be understood by itself.
    pub(super) fn turn_page(&mut self) -> bool {
        let Some((path, ..)) = self.about.clone() else { return false };
        match &self.open {
            Some(open) if open.bytes < LARGEST_FILE => return false,
            Some(_) => self.attempt(|open| open.begin_anew(&path)),
            None => self.open = Open::resume(&path).ok(),
        }
        self.start();
        self.open.is_some()
    }

    /// Writes a line, soon.
    pub(super) fn write(&mut self, entry: Entry<'_>) {
        self.attempt(|open| {
            let time = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or(Duration::ZERO).as_secs_f64();
            let mut line = serde_json::to_vec(&Line { time, entry })?;
            line.push(b'\n');
            open.bytes += line.len() as u64;
            open.file.write_all(&line)
        });
    }

    /// What was written survives this process.
    pub(super) fn flush(&mut self) {
        self.attempt(|open| open.file.flush());
    }

    /// A full disk costs some of the account, not the run.
    fn attempt(&mut self, action: impl FnOnce(&mut Open) -> std::io::Result<()>) {
        if let Some(open) = &mut self.open
            && let Err(error) = action(open)
        {
            let path = self.about.as_ref().map_or(Path::new(""), |(path, ..)| path);
            warn!("{} has a gap from here on: {error}", path.display());
            metrics::account_failed();
            self.open = None;
        }
    }
}

impl Open {
    /// Continues a file. A line that was torn when a learner died is taken away.
    fn resume(path: &Path) -> std::io::Result<Self> {
        let mut file = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(path)?;
        let bytes = whole_lines(&mut file)?;
        file.set_len(bytes)?;
        file.seek(SeekFrom::End(0))?;
        Ok(Self { file: BufWriter::new(file), bytes })
    }

    fn begin_anew(&mut self, path: &Path) -> std::io::Result<()> {
        self.file.flush()?;
        std::fs::rename(path, path.with_extension("1.jsonl"))?;
        self.file = BufWriter::new(File::create(path)?);
        self.bytes = 0;
        Ok(())
    }
}

/// Bytes up to the end of the last whole line.
fn whole_lines(file: &mut File) -> std::io::Result<u64> {
    const BLOCK: u64 = 64 << 10;
    let mut end = file.metadata()?.len();
    let mut block = Vec::new();
    while end > 0 {
        let start = end.saturating_sub(BLOCK);
        file.seek(SeekFrom::Start(start))?;
        block.clear();
        file.take(end - start).read_to_end(&mut block)?;
        if let Some(last) = block.iter().rposition(|&byte| byte == b'\n') {
            return Ok(start + last as u64 + 1);
        }
        end = start;
    }
    Ok(0)
}

/// Numbers as ranges, in rising order.
pub(super) fn ranges(numbers: impl IntoIterator<Item = u64>) -> Vec<[u64; 2]> {
    let mut ranges: Vec<[u64; 2]> = Vec::new();
    for number in numbers.into_iter().collect::<BTreeSet<u64>>() {
        match ranges.last_mut() {
            Some([_, last]) if *last + 1 == number => *last = number,
            _ => ranges.push([number, number]),
        }
    }
    ranges
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_become_ranges() {
        assert_eq!(ranges([5, 3, 4, 9, 1]), [[1, 1], [3, 5], [9, 9]]);
        assert!(ranges([]).is_empty());
    }

    #[test]
    fn a_torn_line_is_taken_away_and_the_rest_stays() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("events.jsonl");
        let finished = |reason| Entry::Finished { reason };
        for (before, kept) in [("", 0), ("{}\n", 1), ("{}\n{\"torn\": ", 1), ("torn", 0)] {
            let torn = format!(
                "{before}{}",
                if kept == 1 && !before.ends_with('\n') { "x".repeat(200_000) } else { String::new() }
            );
            std::fs::write(&path, torn).unwrap();
            let mut account = Account::open(&path, "run", 0).unwrap();
            account.write(finished("enough"));
            account.flush();
            let text = std::fs::read_to_string(&path).unwrap();
            let lines: Vec<serde_json::Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
            assert_eq!(lines.len(), kept + 2, "{before}");
            assert_eq!(lines[kept]["event"], "started");
            assert_eq!((&lines[kept + 1]["event"], &lines[kept + 1]["reason"]), (&"finished".into(), &"enough".into()));
        }
    }

    #[test]
    fn a_full_disk_costs_a_part_of_the_account_and_nothing_else() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("events.jsonl");
        let file = BufWriter::new(OpenOptions::new().write(true).open("/dev/full").unwrap());
        let about = Some((path.clone(), "run".to_owned(), 1));
        let mut account = Account { open: Some(Open { file, bytes: 0 }), about };
        account.write(Entry::Finished { reason: "enough" });
        account.flush();
        assert!(account.open.is_none());
        account.write(Entry::Finished { reason: "enough" });
        // There is room again.
        assert!(account.turn_page());
        account.flush();
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text.lines().count() == 1 && text.contains("\"started\""), "{text}");
        assert!(!account.turn_page());
    }

    #[test]
    fn a_large_file_is_put_aside() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("events.jsonl");
        let mut account = Account::open(&path, "run", 0).unwrap();
        account.write(Entry::Joined { actor: "old", returned: false });
        assert!(!account.turn_page());
        account.open.as_mut().unwrap().bytes = LARGEST_FILE;
        assert!(account.turn_page());
        account.write(Entry::Joined { actor: "new", returned: false });
        account.flush();
        let events = |path: &Path| -> Vec<String> {
            let text = std::fs::read_to_string(path).unwrap();
            let lines = text.lines().map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap());
            lines.map(|line| format!("{} {}", line["event"], line["actor"])).collect()
        };
        assert_eq!(events(&dir.path().join("events.1.jsonl")), ["\"started\" null", "\"joined\" \"old\""]);
        assert_eq!(events(&path), ["\"started\" null", "\"joined\" \"new\""]);
    }
}

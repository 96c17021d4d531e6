//! What `metrics.csv` and `timing.csv` have in common: one row per epoch, appended, and cut on resumption.

use std::fs;
use std::io::ErrorKind;
use std::marker::PhantomData;
use std::path::Path;

use anyhow::{Context as _, bail, ensure};
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::files::{self, AppendFile};

/// A row of a table.
pub(super) trait Row: Serialize + DeserializeOwned {
    /// Name of the file in the run directory.
    const FILE: &'static str;
    /// First line of the file: the names of the fields, in order.
    const HEADER: &'static str;
    /// Whether every epoch must have its row when a run is resumed.
    const COMPLETE: bool;

    /// Epochs completed before this row's.
    fn epoch(&self) -> u64;
}

/// An open table, to which rows are appended.
pub(super) struct CsvTable<R> {
    file: AppendFile,
    row: PhantomData<fn(&R)>,
}

impl<R: Row> CsvTable<R> {
    /// Opens the table in `dir` for a run that has completed `epochs` epochs: a new table for 0 of them, otherwise the
    /// rows of these epochs, without later ones and without a torn last line.
    pub(super) fn open(dir: &Path, epochs: u64) -> anyhow::Result<Self> {
        let path = dir.join(R::FILE);
        let mut kept = format!("{}\n", R::HEADER);
        if epochs > 0 {
            let text = match fs::read(&path) {
                Ok(bytes) => String::from_utf8_lossy(&bytes).into_owned(),
                Err(error) if error.kind() == ErrorKind::NotFound => String::new(),
                Err(error) => return Err(error).with_context(|| format!("cannot read {}", path.display())),
            };
            let rows = whole_rows::<R>(&path, &text)?;
            // From the first line that is not a row on, nothing can be trusted.
            let rows = rows.map_while(|line| parse::<R>(line).ok().map(|row| (row.epoch(), line)));
            let mut found = 0;
            for (epoch, line) in rows.filter(|(epoch, _)| *epoch < epochs) {
                if R::COMPLETE && epoch != found {
                    break;
                }
                kept.push_str(line);
                found += 1;
            }
            ensure!(
                !R::COMPLETE || found == epochs,
                "{}: found the rows of {found} epochs, expected {epochs}; the run cannot be resumed without them",
                path.display()
            );
        }
        files::replace(&path, |partial| Ok(fs::write(partial, kept)?))?;
        Ok(Self { file: AppendFile::open(&path)?, row: PhantomData })
    }

    /// Appends a row, which is on the disk on return.
    pub(super) fn push(&mut self, row: &R) -> anyhow::Result<()> {
        let mut writer = csv::WriterBuilder::new().has_headers(false).from_writer(Vec::new());
        writer.serialize(row)?;
        self.file.append(&writer.into_inner().map_err(csv::IntoInnerError::into_error)?)?;
        self.file.sync()
    }
}

/// Reads the rows of the table in `dir`. A torn last line, of a run that was killed, is no row.
pub(super) fn read<R: Row>(dir: &Path) -> anyhow::Result<Vec<R>> {
    let path = dir.join(R::FILE);
    let text = fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))?;
    whole_rows::<R>(&path, &text)?
        .enumerate()
        .map(|(i, line)| parse(line).with_context(|| format!("{}, line {}", path.display(), i + 2)))
        .collect()
}

/// The complete lines of a table after its header, with their line ends.
fn whole_rows<'a, R: Row>(path: &Path, text: &'a str) -> anyhow::Result<impl Iterator<Item = &'a str>> {
    let mut lines = text.split_inclusive('\n').filter(|line| line.ends_with('\n'));
    if let Some(header) = lines.next().map(str::trim_end)
        && header != R::HEADER
    {
        bail!("{}: the columns are `{header}`, expected `{}`", path.display(), R::HEADER);
    }
    Ok(lines)
}

fn parse<R: Row>(line: &str) -> anyhow::Result<R> {
    let mut reader = csv::ReaderBuilder::new().has_headers(false).from_reader(line.as_bytes());
    Ok(reader.deserialize().next().context("an empty line")??)
}

#[cfg(test)]
mod tests {
    use serde::Deserialize;

    use super::*;

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    struct Full {
        epoch: u64,
        x: f64,
    }

    impl Row for Full {
        const FILE: &'static str = "t.csv";
        const HEADER: &'static str = "epoch,x";
        const COMPLETE: bool = true;

        fn epoch(&self) -> u64 {
            self.epoch
        }
    }

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    struct Sparse(u64, f64);

    impl Row for Sparse {
        const FILE: &'static str = "t.csv";
        const HEADER: &'static str = "epoch,x";
        const COMPLETE: bool = false;

        fn epoch(&self) -> u64 {
            self.0
        }
    }

    /// The table after it was opened for `epochs` epochs over `text`, or the error.
    fn reopened<R: Row>(text: &str, epochs: u64) -> anyhow::Result<String> {
        let dir = tempfile::tempdir()?;
        let path = dir.path().join("t.csv");
        fs::write(&path, text)?;
        CsvTable::<R>::open(dir.path(), epochs)?;
        Ok(fs::read_to_string(path)?)
    }

    #[test]
    fn writes_shortest_floats() {
        let dir = tempfile::tempdir().unwrap();
        let mut table = CsvTable::<Full>::open(dir.path(), 0).unwrap();
        let path = dir.path().join("t.csv");
        assert_eq!(fs::read_to_string(&path).unwrap(), "epoch,x\n");
        for (epoch, x) in [(0, 0.1 + 0.2), (1, 1.0), (2, -3e-7), (3, 1e300)] {
            table.push(&Full { epoch, x }).unwrap();
        }
        assert_eq!(fs::read_to_string(&path).unwrap(), "epoch,x\n0,0.30000000000000004\n1,1.0\n2,-3e-7\n3,1e300\n");
        assert_eq!(read::<Full>(dir.path()).unwrap()[2], Full { epoch: 2, x: -3e-7 });
    }

    #[test]
    fn not_a_number_survives() {
        let dir = tempfile::tempdir().unwrap();
        let mut table = CsvTable::<Full>::open(dir.path(), 0).unwrap();
        table.push(&Full { epoch: 0, x: f64::NAN }).unwrap();
        table.push(&Full { epoch: 1, x: f64::NEG_INFINITY }).unwrap();
        let rows = read::<Full>(dir.path()).unwrap();
        assert!(rows[0].x.is_nan() && rows[1].x == f64::NEG_INFINITY);
    }

    #[test]
    fn resumption_cuts() {
        let text = "epoch,x\n0,0.5\n1,1.0\n2,2.0\n3,0.";
        assert_eq!(reopened::<Full>(text, 0).unwrap(), "epoch,x\n");
        assert_eq!(reopened::<Full>(text, 2).unwrap(), "epoch,x\n0,0.5\n1,1.0\n");
        assert_eq!(reopened::<Full>(text, 3).unwrap(), "epoch,x\n0,0.5\n1,1.0\n2,2.0\n");
        // The torn row parses, but it is not the row that was written.
        let error = format!("{:#}", reopened::<Full>("epoch,x\n0,0.5\n1,1.", 2).unwrap_err());
        assert!(error.contains("t.csv") && error.contains("rows of 1 epochs, expected 2"), "{error}");
        assert!(reopened::<Full>("epoch,x\n0,0.5\nrubbish\n1,1.0\n", 2).is_err());
        assert!(reopened::<Full>("epoch,x\n0,0.5\n2,1.0\n", 2).is_err());
        assert!(reopened::<Full>("", 1).is_err());
        let error = reopened::<Full>("epoch,y\n0,0.5\n", 1).unwrap_err().to_string();
        assert!(error.contains("`epoch,y`, expected `epoch,x`"), "{error}");
        assert!(CsvTable::<Full>::open(tempfile::tempdir().unwrap().path(), 1).is_err());
    }

    #[test]
    fn missing_rows_tolerated() {
        assert_eq!(reopened::<Sparse>("epoch,x\n0,0.5\n2,1.0\n5,1.0\n", 5).unwrap(), "epoch,x\n0,0.5\n2,1.0\n");
        assert_eq!(reopened::<Sparse>("", 5).unwrap(), "epoch,x\n");
        assert!(CsvTable::<Sparse>::open(tempfile::tempdir().unwrap().path(), 5).is_ok());
    }

    #[test]
    fn read_names_the_line() {
        let dir = tempfile::tempdir().unwrap();
        fs::write(dir.path().join("t.csv"), "epoch,x\n0,0.5\n1\n2,7").unwrap();
        let error = format!("{:#}", read::<Full>(dir.path()).unwrap_err());
        assert!(error.contains("t.csv, line 3"), "{error}");
    }
}

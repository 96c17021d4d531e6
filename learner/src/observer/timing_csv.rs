//! `timing.csv`: where the time of each epoch went.

use std::path::Path;

use super::csv_table::{self, CsvTable, Row};
use super::{EpochReport, EpochTiming, Observer};

impl Row for EpochTiming {
    const FILE: &'static str = "timing.csv";
    const HEADER: &'static str = "epoch,env_steps,wall_seconds,steps_per_second,collect_seconds,wait_seconds,\
        learn_seconds,other_seconds,surplus_steps,log_prob_difference,actors";
    const COMPLETE: bool = false;

    fn epoch(&self) -> u64 {
        self.epoch
    }
}

/// Writes `timing.csv` in the run directory: a header, then a row per epoch.
pub struct TimingCsv(CsvTable<EpochTiming>);

impl TimingCsv {
    /// Opens the file in `dir` for a run that has completed `epochs` epochs.
    ///
    /// For 0 epochs the file is made anew. Otherwise the rows of these epochs, as far as there are any, are kept and
    /// whatever follows is cut.
    ///
    /// # Errors
    /// If the file cannot be written or has other columns.
    pub fn open(dir: &Path, epochs: u64) -> anyhow::Result<Self> {
        CsvTable::open(dir, epochs).map(Self)
    }

    /// Reads the rows of the file in `dir`, without a torn last line.
    ///
    /// # Errors
    /// If there is no such file, it has other columns, or a line is no row.
    pub fn read(dir: &Path) -> anyhow::Result<Vec<EpochTiming>> {
        csv_table::read(dir)
    }
}

impl Observer for TimingCsv {
    fn epoch(&mut self, report: &EpochReport) -> anyhow::Result<()> {
        self.0.push(&report.timing)
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::super::samples::report;
    use super::*;

    #[test]
    fn header_names_the_fields() {
        let mut writer = csv::Writer::from_writer(Vec::new());
        writer.serialize(report(0).timing).unwrap();
        let text = String::from_utf8(writer.into_inner().unwrap()).unwrap();
        assert_eq!(text.lines().next().unwrap(), EpochTiming::HEADER);
    }

    #[test]
    fn resumed_without_earlier_rows() {
        let dir = tempfile::tempdir().unwrap();
        TimingCsv::open(dir.path(), 7).unwrap().epoch(&report(7)).unwrap();
        let text = fs::read_to_string(dir.path().join("timing.csv")).unwrap();
        assert_eq!(text.lines().nth(1).unwrap(), "7,8000,16.0,500.0,1.5,0.25,0.375,0.125,40,1e-6,4");
    }
}

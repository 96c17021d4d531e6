//! `metrics.csv`: the record of a run, the same bytes for the same run.

use std::path::Path;

use super::csv_table::{self, CsvTable, Row};
use super::{EpochMetrics, EpochReport, Observer};

impl Row for EpochMetrics {
    const FILE: &'static str = "metrics.csv";
    const HEADER: &'static str = "epoch,env_steps,episodes,mean_return,epoch_return,min_return,max_return,mean_length,mmer,\
        policy_loss,value_loss,kl,kl_coef,entropy,explained_variance,grad_norm,learning_rate,valid_fraction";
    const COMPLETE: bool = true;

    fn epoch(&self) -> u64 {
        self.epoch
    }
}

/// Writes `metrics.csv` in the run directory: a header, then a row per epoch, on the disk before the epoch's checkpoint.
pub struct MetricsCsv(CsvTable<EpochMetrics>);

impl MetricsCsv {
    /// The file's name in the run directory.
    pub const FILE: &str = EpochMetrics::FILE;
    /// Its first line: the names of the columns.
    pub const HEADER: &str = EpochMetrics::HEADER;

    /// Opens the file in `dir` for a run that has completed `epochs` epochs.
    ///
    /// For 0 epochs the file is made anew. Otherwise the rows of these epochs are kept and whatever follows is cut.
    ///
    /// # Errors
    /// If the file cannot be written, has other columns, or lacks rows of these epochs.
    pub fn open(dir: &Path, epochs: u64) -> anyhow::Result<Self> {
        CsvTable::open(dir, epochs).map(Self)
    }

    /// Reads the rows of the file in `dir`, without a torn last line.
    ///
    /// # Errors
    /// If there is no such file, it has other columns, or a line is no row.
    pub fn read(dir: &Path) -> anyhow::Result<Vec<EpochMetrics>> {
        csv_table::read(dir)
    }
}

impl Observer for MetricsCsv {
    fn epoch(&mut self, report: &EpochReport) -> anyhow::Result<()> {
        self.0.push(&report.metrics)
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
        writer.serialize(report(0).metrics).unwrap();
        let text = String::from_utf8(writer.into_inner().unwrap()).unwrap();
        assert_eq!(text.lines().next().unwrap(), EpochMetrics::HEADER);
    }

    #[test]
    fn interrupted_run_leaves_the_same_bytes() {
        let whole = tempfile::tempdir().unwrap();
        let mut csv = MetricsCsv::open(whole.path(), 0).unwrap();
        (0..5).for_each(|epoch| csv.epoch(&report(epoch)).unwrap());

        let resumed = tempfile::tempdir().unwrap();
        let mut csv = MetricsCsv::open(resumed.path(), 0).unwrap();
        (0..4).for_each(|epoch| csv.epoch(&report(epoch)).unwrap());
        let mut csv = MetricsCsv::open(resumed.path(), 2).unwrap();
        (2..5).for_each(|epoch| csv.epoch(&report(epoch)).unwrap());

        let bytes = |dir: &tempfile::TempDir| fs::read_to_string(dir.path().join("metrics.csv")).unwrap();
        assert_eq!(bytes(&whole), bytes(&resumed));
        assert_eq!(
            bytes(&whole).lines().nth(2).unwrap(),
            "1,2000,20,-0.25,-0.125,-1.0,0.5,48.0,-0.25,0.01,0.5,0.002,0.2,1.25,0.75,3.5,0.00005,0.9"
        );
        let rows = MetricsCsv::read(whole.path()).unwrap();
        assert_eq!(rows, (0..5).map(|epoch| report(epoch).metrics).collect::<Vec<_>>());
    }
}

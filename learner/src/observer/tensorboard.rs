//! Event files for TensorBoard, written without TensorFlow: TFRecords of `Event` messages.

use std::fs;
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::Context as _;
use prost::Message as _;

use super::{EpochReport, Observer, RunStart, Summary};
use crate::files::AppendFile;

/// Writes scalars to an event file in `tensorboard/` in the run directory. Their x axis is environment steps.
///
/// Every session of a run writes a file of its own; TensorBoard joins them, and drops what an earlier session wrote
/// after the epoch from which a later one was resumed.
#[derive(Default)]
pub struct TensorBoard {
    file: Option<AppendFile>,
}

impl TensorBoard {
    /// The observer; `run_start` makes its file.
    pub fn new() -> Self {
        Self::default()
    }
}

impl Observer for TensorBoard {
    fn run_start(&mut self, start: &RunStart) -> anyhow::Result<()> {
        let dir = start.dir.join("tensorboard");
        fs::create_dir_all(&dir).with_context(|| format!("cannot create {}", dir.display()))?;
        let now = now();
        // Files are read in the order of their names.
        let (seconds, nanos) = (now.as_secs(), now.subsec_nanos());
        let name = format!("events.out.tfevents.{seconds}.{nanos:09}.{}", std::process::id());
        let file = self.file.insert(AppendFile::create(&dir.join(name))?);
        let wall_time = now.as_secs_f64();
        file.append(&record(&Event { wall_time, file_version: Some("brain.Event:2".into()), ..Event::default() }))?;
        if start.epoch > 0 {
            // Whatever was written from this step on belongs to epochs that are not part of the run any more.
            let step = start.env_steps as i64 + 1;
            let session = Some(SessionLog { status: SESSION_START });
            file.append(&record(&Event { wall_time, step, session, ..Event::default() }))?;
        }
        Ok(())
    }

    /// Without effect if `run_start` failed: that has been reported.
    fn epoch(&mut self, report: &EpochReport) -> anyhow::Result<()> {
        let Some(file) = &mut self.file else { return Ok(()) };
        let values =
            scalars(report).into_iter().map(|(tag, value)| Value { tag: tag.into(), value: Some(value as f32) });
        file.append(&record(&Event {
            wall_time: now().as_secs_f64(),
            step: report.metrics.env_steps as i64,
            values: Some(Values { values: values.collect() }),
            ..Event::default()
        }))
    }

    fn run_end(&mut self, _summary: &Summary) -> anyhow::Result<()> {
        self.file.as_ref().map_or(Ok(()), AppendFile::sync)
    }
}

/// Tags and values of an epoch.
fn scalars(EpochReport { metrics, timing }: &EpochReport) -> [(&'static str, f64); 23] {
    [
        ("return/mean", metrics.mean_return),
        ("return/min", metrics.min_return),
        ("return/max", metrics.max_return),
        ("return/mmer", metrics.mmer),
        ("episode/length", metrics.mean_length),
        ("episode/count", metrics.episodes as f64),
        ("loss/policy", metrics.policy_loss),
        ("loss/value", metrics.value_loss),
        ("policy/kl", metrics.kl),
        ("policy/kl_coef", metrics.kl_coef),
        ("policy/entropy", metrics.entropy),
        ("value/explained_variance", metrics.explained_variance),
        ("optimizer/grad_norm", metrics.grad_norm),
        ("optimizer/learning_rate", metrics.learning_rate),
        ("optimizer/valid_fraction", metrics.valid_fraction),
        ("time/steps_per_second", timing.steps_per_second),
        ("time/collect_seconds", timing.collect_seconds),
        ("time/wait_seconds", timing.wait_seconds),
        ("time/learn_seconds", timing.learn_seconds),
        ("time/other_seconds", timing.other_seconds),
        ("sampling/surplus_steps", timing.surplus_steps as f64),
        ("sampling/log_prob_difference", timing.log_prob_difference),
        ("sampling/actors", timing.actors as f64),
    ]
}

fn now() -> std::time::Duration {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default()
}

/// `tensorflow.Event`, as far as it is needed.
#[derive(Clone, PartialEq, prost::Message)]
struct Event {
    #[prost(double, tag = "1")]
    wall_time: f64,
    #[prost(int64, tag = "2")]
    step: i64,
    #[prost(string, optional, tag = "3")]
    file_version: Option<String>,
    #[prost(message, optional, tag = "5")]
    values: Option<Values>,
    #[prost(message, optional, tag = "7")]
    session: Option<SessionLog>,
}

/// `tensorflow.Summary`.
#[derive(Clone, PartialEq, prost::Message)]
struct Values {
    #[prost(message, repeated, tag = "1")]
    values: Vec<Value>,
}

/// `tensorflow.Summary.Value` of a scalar.
#[derive(Clone, PartialEq, prost::Message)]
struct Value {
    #[prost(string, tag = "1")]
    tag: String,
    #[prost(float, optional, tag = "2")]
    value: Option<f32>,
}

/// `tensorflow.SessionLog`.
#[derive(Clone, PartialEq, prost::Message)]
struct SessionLog {
    #[prost(int32, tag = "1")]
    status: i32,
}

/// `tensorflow.SessionLog.START`.
const SESSION_START: i32 = 1;

/// A TFRecord: length, checksum of the length, payload, checksum of the payload; all little-endian.
fn record(event: &Event) -> Vec<u8> {
    let payload = event.encode_to_vec();
    let length = (payload.len() as u64).to_le_bytes();
    let mut record = Vec::with_capacity(payload.len() + 16);
    record.extend_from_slice(&length);
    record.extend_from_slice(&masked_crc(&length).to_le_bytes());
    record.extend_from_slice(&payload);
    record.extend_from_slice(&masked_crc(&payload).to_le_bytes());
    record
}

/// CRC-32C, rotated and shifted by a constant as TFRecords have it, so that a checksum of checksums stays sound.
fn masked_crc(bytes: &[u8]) -> u32 {
    crc32c::crc32c(bytes).rotate_right(15).wrapping_add(0xa282_ead8)
}

#[cfg(test)]
mod tests {
    use std::path::{Path, PathBuf};

    use super::super::samples::{report, start, summary};
    use super::*;

    /// Records and messages as tensorboard 2.21.0's `RecordWriter` and `event_pb2` write them.
    #[test]
    fn bytes_of_tensorboards_own_writer() {
        let version =
            Event { wall_time: 1_700_000_000.5, file_version: Some("brain.Event:2".into()), ..Event::default() };
        let value = |tag: &str, value| Value { tag: tag.into(), value: Some(value) };
        let scalars = Event {
            wall_time: 1_700_000_001.25,
            step: 65536,
            values: Some(Values { values: vec![value("return/mean", -0.5), value("loss/value", 0.0)] }),
            ..Event::default()
        };
        let session = Event {
            wall_time: 1_700_000_000.5,
            step: 3001,
            session: Some(SessionLog { status: SESSION_START }),
            ..Event::default()
        };
        let hex = |event| record(event).iter().fold(String::new(), |text, byte| text + &format!("{byte:02x}"));
        assert_eq!(hex(&version), "1800000000000000a37f4b220900002040fc54d9411a0d627261696e2e4576656e743a322b353110");
        assert_eq!(
            hex(&scalars),
            "36000000000000004f578cef0900005040fc54d941108080042a270a120a0b72657475726e2f6d65616e15000000bf\
             0a110a0a6c6f73732f76616c756515000000009b0f28e4"
        );
        assert_eq!(hex(&session), "100000000000000095fbfe180900002040fc54d94110b9173a02080176ba335c");
    }

    /// Checksum of RFC 3720, bit by bit, masked as the description of TFRecords says.
    fn reference_crc(bytes: &[u8]) -> u32 {
        let mut crc = !0_u32;
        for byte in bytes {
            crc ^= u32::from(*byte);
            for _ in 0..8 {
                crc = (crc >> 1) ^ (0x82f6_3b78 * (crc & 1));
            }
        }
        crc = !crc;
        crc.rotate_right(15).wrapping_add(0xa282_ead8)
    }

    fn decode(path: &Path) -> Vec<Event> {
        let mut bytes = fs::read(path).unwrap();
        let mut events = Vec::new();
        while !bytes.is_empty() {
            let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
            assert_eq!(bytes[8..12], reference_crc(&bytes[..8]).to_le_bytes());
            let payload = &bytes[12..12 + length];
            assert_eq!(bytes[12 + length..16 + length], reference_crc(payload).to_le_bytes());
            events.push(Event::decode(payload).unwrap());
            bytes.drain(..16 + length);
        }
        events
    }

    fn files(dir: &Path) -> Vec<PathBuf> {
        let mut files: Vec<_> =
            fs::read_dir(dir.join("tensorboard")).unwrap().map(|file| file.unwrap().path()).collect();
        files.sort();
        files
    }

    #[test]
    fn sessions_write_files_in_order() {
        // RFC 3720, B.4: the checksum of 32 zeros is 0x8a9136aa.
        assert_eq!(reference_crc(&[0; 32]), 0x8a91_36aa_u32.rotate_right(15).wrapping_add(0xa282_ead8));
        let dir = tempfile::tempdir().unwrap();
        for (first, epochs) in [(0, 3), (2, 4)] {
            let mut observer = TensorBoard::new();
            observer.run_start(&start(dir.path(), first)).unwrap();
            (first..epochs).for_each(|epoch| observer.epoch(&report(epoch)).unwrap());
            observer.run_end(&summary(epochs)).unwrap();
        }
        let files = files(dir.path());
        assert_eq!(files.len(), 2);
        assert!(files[0].file_name().unwrap().to_str().unwrap().starts_with("events.out.tfevents.1"));
        let [first, second] = [0, 1].map(|i| decode(&files[i]));
        assert_eq!(first[0].file_version.as_deref(), Some("brain.Event:2"));
        assert_eq!(first.iter().map(|event| event.step).collect::<Vec<_>>(), [0, 1000, 2000, 3000]);
        assert_eq!(second.iter().map(|event| event.step).collect::<Vec<_>>(), [0, 2001, 3000, 4000]);
        assert_eq!(second[1].session, Some(SessionLog { status: 1 }));
        let values = &first[2].values.as_ref().unwrap().values;
        assert_eq!((values[0].tag.as_str(), values[0].value), ("return/mean", Some(-0.25)));
        let tags: std::collections::HashSet<_> = values.iter().map(|value| &value.tag).collect();
        assert_eq!(tags.len(), 23, "a tag twice");
    }

    #[test]
    fn unwritable_directory_is_reported_once() {
        let dir = tempfile::tempdir().unwrap();
        fs::write(dir.path().join("tensorboard"), "a file").unwrap();
        let mut observer = TensorBoard::new();
        let error = observer.run_start(&start(dir.path(), 0)).unwrap_err().to_string();
        assert!(error.contains("tensorboard"), "{error}");
        observer.epoch(&report(0)).unwrap();
    }
}

//! Files that survive crashes and full disks.

use std::fs::{self, File};
use std::io::Write as _;
use std::path::{Path, PathBuf};

use anyhow::Context as _;

use crate::fail_point;

/// Writes a file under a temporary name beside `path` by `write`, then renames it to `path`: readers see the old file
/// or the new one, whole. The temporary name keeps the extension.
pub(crate) fn replace(path: &Path, write: impl FnOnce(&Path) -> anyhow::Result<()>) -> anyhow::Result<()> {
    let partial = partial(path)?;
    let done: anyhow::Result<()> = (|| {
        write(&partial)?;
        File::open(&partial)?.sync_all()?;
        fs::rename(&partial, path)?;
        if let Some(dir) = path.parent() {
            sync_dir(dir);
        }
        Ok(())
    })();
    if done.is_err() {
        let _ = fs::remove_file(&partial);
    }
    done.with_context(|| format!("cannot write {}", path.display()))
}

/// Makes renames in `dir` durable; not every file system can.
pub(crate) fn sync_dir(dir: &Path) {
    let _ = File::open(dir).and_then(|dir| dir.sync_all());
}

/// Checks that [`replace`] can begin: that there is no directory at `path`, and that its own can be written to.
pub(crate) fn check_writable(path: &Path) -> anyhow::Result<()> {
    let check = || {
        anyhow::ensure!(!path.is_dir(), "it is a directory");
        let partial = partial(path)?;
        File::create(&partial)?;
        Ok(fs::remove_file(&partial)?)
    };
    check().with_context(|| format!("cannot write {}", path.display()))
}

/// The temporary name beside `path`.
fn partial(path: &Path) -> anyhow::Result<PathBuf> {
    let name = path.file_name().with_context(|| format!("{} names no file", path.display()))?;
    Ok(path.with_file_name(format!(".partial-{}", name.to_string_lossy())))
}

/// Replaces the file at `path` by `text`, as [`replace`] does.
pub(crate) fn write(path: &Path, text: &str) -> anyhow::Result<()> {
    replace(path, |partial| Ok(fs::write(partial, text)?))
}

/// A file that only grows, by whole records.
///
/// What cannot be written (a full disk) is kept, the file is cut back to its last whole record, and the next
/// [`append`](Self::append) tries again: no record is torn in the middle, none is missing.
pub(crate) struct AppendFile {
    path: PathBuf,
    file: File,
    len: u64,
    pending: Vec<u8>,
}

impl AppendFile {
    /// Creates `path`, which must not exist.
    pub(crate) fn create(path: &Path) -> anyhow::Result<Self> {
        let file = File::options().append(true).create_new(true).open(path);
        Self::new(path, file)
    }

    /// Goes on after the end of `path`, which must exist.
    pub(crate) fn open(path: &Path) -> anyhow::Result<Self> {
        Self::new(path, File::options().append(true).open(path))
    }

    fn new(path: &Path, file: std::io::Result<File>) -> anyhow::Result<Self> {
        let opened = file.and_then(|file| file.metadata().map(|metadata| (file, metadata.len())));
        let (file, len) = opened.with_context(|| format!("cannot open {}", path.display()))?;
        Ok(Self { path: path.to_owned(), file, len, pending: Vec::new() })
    }

    /// Appends a record, after those that an earlier call could not write.
    pub(crate) fn append(&mut self, record: &[u8]) -> anyhow::Result<()> {
        self.pending.extend_from_slice(record);
        fail_point::reached_with("a record half written", || {
            let _ = self.file.write_all(&self.pending[..self.pending.len() / 2]);
        });
        if let Err(error) = self.file.write_all(&self.pending) {
            let _ = self.file.set_len(self.len);
            return Err(error).with_context(|| format!("cannot write {}", self.path.display()));
        }
        self.len += self.pending.len() as u64;
        self.pending.clear();
        Ok(())
    }

    /// Waits until all that was appended is on the disk.
    pub(crate) fn sync(&self) -> anyhow::Result<()> {
        fail_point::reached("a record not yet synced");
        self.file.sync_data().with_context(|| format!("cannot sync {}", self.path.display()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn replaced_whole_or_not_at_all() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.txt");
        replace(&path, |partial| Ok(fs::write(partial, "old")?)).unwrap();
        let failed = replace(&path, |partial| {
            fs::write(partial, "ne")?;
            anyhow::bail!("no space")
        });
        assert!(format!("{:#}", failed.unwrap_err()).contains("a.txt: no space"));
        assert_eq!(fs::read_to_string(&path).unwrap(), "old");
        assert_eq!(fs::read_dir(&dir).unwrap().count(), 1, "the partial file is left behind");
        replace(&path, |partial| Ok(fs::write(partial, "new")?)).unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "new");
    }

    #[test]
    fn writable_or_not() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.txt");
        check_writable(&path).unwrap();
        assert_eq!(fs::read_dir(&dir).unwrap().count(), 0, "the check leaves nothing behind");
        fs::write(&path, "old").unwrap();
        check_writable(&path).unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "old");
        for bad in [dir.path().to_owned(), path.join("below a file"), dir.path().join("gone/a.txt"), "..".into()] {
            let error = format!("{:#}", check_writable(&bad).unwrap_err());
            assert!(error.contains(&bad.display().to_string()), "{error}");
        }
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn full_disk_delays_records() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.txt");
        let mut file = AppendFile::create(&path).unwrap();
        file.append(b"1\n").unwrap();
        let full = File::options().append(true).open("/dev/full").unwrap();
        let good = std::mem::replace(&mut file.file, full);
        assert!(format!("{:#}", file.append(b"2\n").unwrap_err()).contains("a.txt"));
        file.file = good;
        file.append(b"3\n").unwrap();
        file.sync().unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "1\n2\n3\n");
        assert!(AppendFile::create(&path).is_err(), "an existing file was created again");
        AppendFile::open(&path).unwrap().append(b"4\n").unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "1\n2\n3\n4\n");
    }
}

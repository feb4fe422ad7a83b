//! Files that the server makes, with modes of their own whatever the process's umask is.

use std::fs::{self, File, OpenOptions, Permissions};
use std::os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _, PermissionsExt as _};
use std::path::Path;
use std::str::FromStr;
use std::{fmt, io};

use serde::{Deserialize, Serialize};

/// Permissions of a file: who may read and write it. Written in octal, `0660`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Mode(u32);

/// Not a mode.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{0}` is no mode of a file; write it in octal, between 0600 and 0666, such as 0660")]
pub struct ModeError(String);

impl Mode {
    /// For the owner alone.
    pub const PRIVATE: Self = Self(0o600);
    /// For the owner and the group.
    pub const GROUP: Self = Self(0o660);
    /// The owner writes, everybody reads.
    pub const PUBLIC: Self = Self(0o644);

    /// As the system takes it.
    pub fn bits(self) -> u32 {
        self.0
    }

    /// That of a directory of such files: whoever may read them may go into it.
    fn of_directory(self) -> u32 {
        self.0 | (self.0 & 0o444) >> 2
    }

    /// A new file for writing, which has had no other mode at any time. What stands there is refused.
    pub fn create_new(self, path: &Path) -> io::Result<File> {
        let file = OpenOptions::new().write(true).create_new(true).mode(self.0).open(path)?;
        // The umask may have taken away what was asked for.
        file.set_permissions(Permissions::from_mode(self.0))?;
        Ok(file)
    }

    /// Creates a file, in place of one that may have been left there.
    pub fn create(self, path: &Path) -> io::Result<File> {
        match fs::remove_file(path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
            _ => self.create_new(path),
        }
    }

    /// A file for writing: the one that is there, or a new one.
    pub fn open_or_create(self, path: &Path) -> io::Result<File> {
        OpenOptions::new().write(true).create(true).truncate(false).mode(self.0).open(path)
    }

    /// A directory for such files, with those above it. One that is there stays as it is.
    pub fn create_directory(self, path: &Path) -> io::Result<()> {
        fs::DirBuilder::new().recursive(true).mode(self.of_directory()).create(path)
    }
}

impl FromStr for Mode {
    type Err = ModeError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let refused = || ModeError(text.to_owned());
        let bits = u32::from_str_radix(text, 8).map_err(|_| refused())?;
        // The server itself reads and writes; nobody executes.
        let is_good = bits & 0o600 == 0o600 && bits & !0o666 == 0;
        is_good.then_some(Self(bits)).ok_or_else(refused)
    }
}

impl TryFrom<String> for Mode {
    type Error = ModeError;

    fn try_from(text: String) -> Result<Self, Self::Error> {
        text.parse()
    }
}

impl From<Mode> for String {
    fn from(mode: Mode) -> Self {
        mode.to_string()
    }
}

impl fmt::Display for Mode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:04o}", self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn modes_are_read_and_written_in_octal() {
        for (text, bits) in [("0600", 0o600), ("660", 0o660), ("0666", 0o666)] {
            let mode: Mode = text.parse().unwrap();
            assert_eq!((mode.bits(), mode.to_string().len()), (bits, 4));
        }
        for wrong in ["", "0066", "0400", "0700", "0768", "rw-rw----", "4660"] {
            assert!(wrong.parse::<Mode>().unwrap_err().to_string().contains(wrong), "{wrong}");
        }
        let directories = [Mode::PRIVATE, Mode::GROUP, Mode::PUBLIC].map(Mode::of_directory);
        assert_eq!(directories, [0o700, 0o770, 0o755]);
    }

    #[test]
    fn a_file_that_was_left_with_another_mode_is_replaced() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("file");
        fs::write(&path, "old").unwrap();
        fs::set_permissions(&path, Permissions::from_mode(0o666)).unwrap();
        assert!(Mode::PRIVATE.create_new(&path).is_err());
        let file = Mode::PRIVATE.create(&path).unwrap();
        assert_eq!(file.metadata().unwrap().permissions().mode() & 0o7777, 0o600);
        assert_eq!(fs::read(&path).unwrap(), b"");
    }
}

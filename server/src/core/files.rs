//! Files of uploaded models: meshes that show them, and what meshes refer to. They are held in memory under the
//! names that scenes have for them, are never opened under these, and no step reads them.

use std::collections::BTreeMap;
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::sync::{Arc, Mutex};

use crate::core::limits::{LimitExceeded, Limits};
use crate::core::mutex::lock;
use crate::core::room::{Reservation, Room};

/// Extensions of files that a model may have.
pub const EXTENSIONS: [&str; 7] = ["stl", "obj", "dae", "glb", "mtl", "png", "jpg"];

/// Bytes of a path.
const PATH_BYTES_MAX: usize = 1024;

/// Schemes that stand for folders which only the scene's author knows.
const SCHEMES: [&str; 2] = ["package://", "model://"];

/// Why a file has a name that no file of a model has.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FileNameError {
    /// It is empty or too long.
    #[error("has {0} bytes; 1 to {PATH_BYTES_MAX} are allowed")]
    Length(usize),
    /// It leads out of the model's folder.
    #[error("is `{0}`; a path below the scene is needed: neither absolute nor with `..`")]
    Outside(String),
    /// It has characters that do not stand in paths everywhere.
    #[error("is `{0}`; letters, digits, `-`, `_`, `.`, `+` and `/` are allowed")]
    Characters(String),
    /// Its extension is none that is served.
    #[error("is `{0}`; it must end with one of .{ends}", ends = EXTENSIONS.join(", ."))]
    Extension(String),
}

/// The path under which a file of a model is served: its name in the scene, without `package://`.
pub fn path_of(name: &str) -> Result<String, FileNameError> {
    if name.is_empty() || name.len() > PATH_BYTES_MAX {
        return Err(FileNameError::Length(name.len()));
    }
    let path = SCHEMES.iter().find_map(|scheme| name.strip_prefix(scheme)).unwrap_or(name);
    let path = path.strip_prefix("./").unwrap_or(path);
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_.+/".contains(c);
    if !path.chars().all(is_plain) {
        return Err(FileNameError::Characters(name.to_owned()));
    }
    if path.split('/').any(|part| ["", ".", ".."].contains(&part)) {
        return Err(FileNameError::Outside(name.to_owned()));
    }
    match extension(path) {
        Some(_) => Ok(path.to_owned()),
        None => Err(FileNameError::Extension(name.to_owned())),
    }
}

fn extension(path: &str) -> Option<&'static str> {
    let (stem, end) = path.rsplit_once('.')?;
    let is_named = !stem.is_empty() && !stem.ends_with('/');
    EXTENSIONS.into_iter().find(|known| is_named && known.eq_ignore_ascii_case(end))
}

/// A file.
#[derive(Debug)]
pub struct File {
    /// Its bytes.
    pub bytes: Vec<u8>,
    /// One of [`EXTENSIONS`].
    pub extension: &'static str,
    /// Another one for other bytes.
    pub tag: u64,
    _room: Reservation,
}

/// A number that tells contents apart.
pub fn tag(bytes: &[u8]) -> u64 {
    let mut hasher = DefaultHasher::new();
    bytes.hash(&mut hasher);
    hasher.finish()
}

/// The files of a model, by path.
#[derive(Debug, Default)]
pub struct Files {
    files: Mutex<BTreeMap<String, Arc<File>>>,
}

impl Files {
    /// The file at a path.
    pub fn get(&self, path: &str) -> Option<Arc<File>> {
        lock(&self.files).get(path).cloned()
    }

    /// The path under which a file of the scene is served and its tag, if it is there.
    pub fn find(&self, name: &str) -> Option<(String, u64)> {
        let path = path_of(name).ok()?;
        let tag = self.get(&path)?.tag;
        Some((path, tag))
    }
}

/// Room for the files of all models.
#[derive(Debug)]
pub(crate) struct FileRoom {
    bytes: Arc<Room>,
    bytes_max: u64,
    files_max: u64,
}

impl FileRoom {
    pub(crate) fn new(limits: &Limits) -> Self {
        let what = "bytes in the files of all models";
        Self {
            bytes: Room::new("model_files_bytes", what, limits.model_files_bytes),
            bytes_max: limits.model_file_bytes,
            files_max: limits.model_files,
        }
    }

    pub(crate) fn check_size(&self, bytes: usize) -> Result<(), LimitExceeded> {
        LimitExceeded::check("model_file_bytes", self.bytes_max, "bytes in a file", bytes)
    }

    /// Puts a file at a path, in the place of the one that is there.
    pub(crate) fn put(
        &self,
        files: &Files,
        path: &str,
        bytes: Vec<u8>,
    ) -> Result<Arc<File>, LimitExceeded> {
        self.check_size(bytes.len())?;
        let room = self.bytes.reserve(bytes.len())?;
        let extension = extension(path).unwrap_or(EXTENSIONS[0]);
        let file = Arc::new(File { tag: tag(&bytes), bytes, extension, _room: room });
        let mut files = lock(&files.files);
        let count = files.len() + usize::from(!files.contains_key(path));
        LimitExceeded::check("model_files", self.files_max, "files of a model", count)?;
        files.insert(path.to_owned(), Arc::clone(&file));
        Ok(file)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_stay_below_the_scene() {
        for (name, path) in [
            ("meshes/palm.obj", "meshes/palm.obj"),
            ("package://panda/meshes/link0.STL", "panda/meshes/link0.STL"),
            ("./a-b_c+1.glb", "a-b_c+1.glb"),
            ("a..b/c.dae", "a..b/c.dae"),
        ] {
            assert_eq!(path_of(name).as_deref(), Ok(path), "{name}");
        }
        for name in ["../a.stl", "/etc/a.stl", "a/../b.stl", "a//b.stl", "a/./b.stl", "a/"]
            .into_iter()
            .chain(["file:///a.stl", "package:///a.stl", "package://../a.stl", ".//a.stl"])
            .chain(["a b.stl", "a%2e.stl", "a\\b.stl", "a\0.stl", "ü.stl", "a?b.stl", ""])
            .chain([
                "a.html",
                "a.svg",
                "a.js",
                "stl",
                ".stl",
                "a/.stl",
                "a.stl.exe",
                "http://a/b.stl",
            ])
        {
            assert!(path_of(name).is_err(), "{name}");
        }
        assert!(path_of(&format!("{}.stl", "a".repeat(1024))).is_err());
    }

    #[test]
    fn files_have_room_until_they_are_gone() {
        let limits = Limits {
            model_file_bytes: 6,
            model_files_bytes: 10,
            model_files: 2,
            ..Limits::default()
        };
        let (room, files) = (FileRoom::new(&limits), Files::default());
        let put = |path: &str, count: usize| room.put(&files, path, vec![7; count]);
        assert_eq!(put("a.stl", 7).unwrap_err().name, "model_file_bytes");
        put("a.stl", 6).unwrap();
        assert_eq!(put("b.stl", 5).unwrap_err().name, "model_files_bytes");
        put("b.stl", 1).unwrap();
        assert_eq!(put("c.stl", 1).unwrap_err().name, "model_files");
        put("b.stl", 2).unwrap();
        assert_eq!(files.get("b.stl").unwrap().bytes.len(), 2);
        assert_eq!(files.find("./b.stl").unwrap().1, tag(&[7, 7]));
        drop(files);
        room.put(&Files::default(), "d.stl", vec![1; 6]).unwrap();
    }
}

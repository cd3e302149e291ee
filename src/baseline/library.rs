//! Where baselines are found: those shipped inside the program, and those of a models folder.
//!
//! ```text
//!  DIR/<folder>/structure.toml (or .json)                 the structure
//!  DIR/<folder>/<name>.safetensors + <name>.json          a trained baseline of it
//! ```

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::Baseline;
use crate::flow::checkpoint::LARGEST_FILE_BYTES;
use crate::quantity::{Digest, StructureId};
use crate::simulator::definition::{DefinitionError, StructureDefinition};
use crate::simulator::Simulator;

#[derive(rust_embed::Embed)]
#[folder = "models/"]
struct Shipped;

/// A structure of the library, with its baseline if one could be loaded.
#[derive(Clone)]
pub struct Entry {
    /// The structure.
    pub simulator: Simulator,
    /// Its trained baseline.
    pub baseline: Option<Arc<Baseline>>,
}

/// A file of the models folder that was not read, and why.
struct Unread {
    file: String,
    reason: String,
}

/// A file that was found and refused.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, utoipa::ToSchema)]
pub struct Refusal {
    /// The file.
    pub file: String,
    /// The structure it belongs to, if that much could be read.
    pub structure: Option<StructureId>,
    /// Why, and what would be right.
    pub reason: String,
}

/// All structures and baselines at hand.
#[derive(Clone, Default)]
pub struct Library {
    entries: BTreeMap<StructureId, Entry>,
    refusals: Vec<Refusal>,
    folder: Option<PathBuf>,
}

/// The two files of a trained baseline.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BaselineFiles {
    /// The manifest.
    pub manifest: Vec<u8>,
    /// The weights.
    pub weights: Vec<u8>,
    /// `program` for those shipped inside it, else the folder.
    pub kept_in: String,
}

/// Why a models folder cannot be read at all.
#[derive(Debug, thiserror::Error)]
#[error("the models folder {path} cannot be read: {source}")]
pub struct FolderError {
    path: PathBuf,
    source: std::io::Error,
}

/// Files of one folder of the library, by name.
type Folder = BTreeMap<String, Vec<u8>>;

impl Library {
    /// The shipped baselines, and over them those of `folder`: a folder for the same structure replaces the shipped one.
    ///
    /// A file that is refused is no error: the other baselines serve, and [`Self::refusals`] says what is wrong.
    ///
    /// # Errors
    /// [`FolderError`] when `folder` cannot be listed.
    pub fn open(folder: Option<&Path>) -> Result<Self, FolderError> {
        let mut library = Self { folder: folder.map(Path::to_owned), ..Self::default() };
        for (name, files) in shipped_folders() {
            library.add(&format!("shipped:{name}"), &files);
        }
        if let Some(path) = folder {
            let failed = |source| FolderError { path: path.to_owned(), source };
            for (name, (files, unread)) in read_folders(path).map_err(failed)? {
                let origin = path.join(name).display().to_string();
                let structure = library.add(&origin, &files);
                for Unread { file, reason } in unread {
                    library.refuse(format!("{origin}/{file}"), structure.as_ref(), &reason);
                }
            }
        }
        Ok(library)
    }

    /// The same places read again: what lies there now.
    ///
    /// # Errors
    /// [`FolderError`] when the folder cannot be listed.
    pub fn read_again(&self) -> Result<Self, FolderError> {
        Self::open(self.folder.as_deref())
    }

    /// The folder that goes over the shipped baselines.
    pub fn folder(&self) -> Option<&Path> {
        self.folder.as_deref()
    }

    /// The files of the baseline with this digest, if they still lie where they were read from.
    ///
    /// # Errors
    /// [`FolderError`] when the folder cannot be listed.
    pub fn files_of(&self, digest: &Digest) -> Result<Option<BaselineFiles>, FolderError> {
        let mut folders: Vec<(String, Folder)> =
            shipped_folders().into_values().map(|files| ("program".to_owned(), files)).collect();
        if let Some(path) = &self.folder {
            let failed = |source| FolderError { path: path.clone(), source };
            let own = read_folders(path).map_err(failed)?;
            folders.extend(own.into_iter().map(|(name, (files, _))| (path.join(name).display().to_string(), files)));
        }
        for (kept_in, files) in folders {
            for (name, manifest) in files.iter().filter(|(name, _)| has_extension(name, "json")) {
                let weights = files.get(&name.replace(".json", ".safetensors"));
                if let Some(weights) = weights.filter(|_| Digest::of_file(manifest) == *digest) {
                    let (manifest, weights) = (manifest.clone(), weights.clone());
                    return Ok(Some(BaselineFiles { manifest, weights, kept_in }));
                }
            }
        }
        Ok(None)
    }

    /// A structure by its id.
    pub fn get(&self, id: &StructureId) -> Option<&Entry> {
        self.entries.get(id)
    }

    /// All structures in the order of their ids.
    pub fn iter(&self) -> impl Iterator<Item = (&StructureId, &Entry)> {
        self.entries.iter()
    }

    /// The files that were refused.
    pub fn refusals(&self) -> &[Refusal] {
        &self.refusals
    }

    /// Takes up a folder; the structure in it, if there is one.
    fn add(&mut self, origin: &str, files: &Folder) -> Option<StructureId> {
        let (name, text) = files.iter().find(|(name, _)| is_definition(name))?;
        let simulator = match read_definition(name, text, |file| in_folder(files, file)) {
            Ok(simulator) => simulator,
            Err(error) => {
                self.refuse(format!("{origin}/{name}"), None, &error);
                return None;
            }
        };
        let id = simulator.id().clone();
        let mut baseline = None;
        for (file, weights) in files.iter().filter(|(name, _)| has_extension(name, "safetensors")) {
            let manifest_name = file.replace(".safetensors", ".json");
            let path = format!("{origin}/{file}");
            let Some(manifest) = files.get(&manifest_name) else {
                self.refuse(path, Some(&id), &format!("its manifest {manifest_name} is missing beside it"));
                continue;
            };
            match Baseline::load(manifest, weights, &simulator) {
                Ok(loaded) if baseline.is_none() => baseline = Some(Arc::new(loaded)),
                Ok(_) => self.refuse(path, Some(&id), &"another baseline of this folder, earlier by name, is in use"),
                Err(error) => self.refuse(path, Some(&id), &error),
            }
        }
        self.entries.insert(id.clone(), Entry { simulator, baseline });
        Some(id)
    }

    fn refuse(&mut self, file: String, structure: Option<&StructureId>, reason: &dyn std::fmt::Display) {
        self.refusals.push(Refusal { file, structure: structure.cloned(), reason: reason.to_string() });
    }
}

/// Why a structure file gives no simulator.
#[derive(Debug, thiserror::Error)]
pub enum StructureFileError {
    /// The file cannot be read.
    #[error("{path} cannot be read as a structure file ({source}); the shipped structures are {shipped}")]
    Read {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
        /// What could have been meant instead.
        shipped: String,
    },
    /// It is no structure.
    #[error("{path}: {source}")]
    Definition {
        /// The file.
        path: PathBuf,
        /// What is wrong, with its place.
        source: DefinitionError,
    },
}

/// Reads a structure file, TOML or, with the extension `json`, JSON.
///
/// # Errors
/// [`StructureFileError`] with the file's name and the place in it.
pub fn read_structure_file(path: &Path) -> Result<Simulator, StructureFileError> {
    let bytes = std::fs::read(path).map_err(|source| {
        let shipped = shipped_folders().into_keys().collect::<Vec<_>>().join(", ");
        StructureFileError::Read { path: path.to_owned(), source, shipped }
    })?;
    let name = path.to_string_lossy();
    let beside = |file: &str| std::fs::read_to_string(path.parent().unwrap_or(Path::new("")).join(file));
    read_definition(&name, &bytes, beside)
        .map_err(|source| StructureFileError::Definition { path: path.to_owned(), source })
}

/// A shipped or stored structure for the command line: a file, or the id of a shipped structure.
///
/// # Errors
/// [`StructureFileError`] when it is neither.
pub fn find_structure(path_or_id: &str) -> Result<Simulator, StructureFileError> {
    let shipped = shipped_folders().into_values().find_map(|files| {
        let (name, text) = files.iter().find(|(name, _)| is_definition(name))?;
        read_definition(name, text, |file| in_folder(&files, file))
            .ok()
            .filter(|simulator| simulator.id().as_str() == path_or_id)
    });
    match shipped {
        Some(simulator) if !Path::new(path_or_id).exists() => Ok(simulator),
        _ => read_structure_file(Path::new(path_or_id)),
    }
}

/// A text file of a folder in memory.
fn in_folder(files: &Folder, file: &str) -> std::io::Result<String> {
    let bytes = files.get(file).ok_or_else(|| std::io::Error::from(std::io::ErrorKind::NotFound))?;
    String::from_utf8(bytes.clone()).map_err(|e| std::io::Error::new(std::io::ErrorKind::InvalidData, e))
}

fn read_definition(
    name: &str,
    bytes: &[u8],
    beside: impl Fn(&str) -> std::io::Result<String>,
) -> Result<Simulator, DefinitionError> {
    let text = String::from_utf8_lossy(bytes);
    let is_json = Path::new(name).extension().is_some_and(|e| e.eq_ignore_ascii_case("json"));
    let definition = if is_json {
        StructureDefinition::parse_json_beside(&text, beside)
    } else {
        StructureDefinition::parse_toml_beside(&text, beside)
    }?;
    Simulator::new(definition)
}

fn has_extension(name: &str, extension: &str) -> bool {
    Path::new(name).extension().is_some_and(|found| found == extension)
}

fn is_definition(name: &str) -> bool {
    name == "structure.toml" || name == "structure.json"
}

fn shipped_folders() -> BTreeMap<String, Folder> {
    let mut folders = BTreeMap::<String, Folder>::new();
    for path in Shipped::iter() {
        if let (Some((folder, file)), Some(content)) = (path.split_once('/'), Shipped::get(&path)) {
            folders.entry(folder.to_owned()).or_default().insert(file.to_owned(), content.data.into_owned());
        }
    }
    folders
}

/// The files of a models folder by folder, and those that were not read: one bad file must not keep the service from starting.
fn read_folders(path: &Path) -> std::io::Result<BTreeMap<String, (Folder, Vec<Unread>)>> {
    let mut folders = BTreeMap::new();
    for entry in std::fs::read_dir(path)? {
        let entry = entry?;
        if !entry.file_type()?.is_dir() {
            continue;
        }
        let (mut files, mut unread) = (Folder::new(), Vec::new());
        for file in std::fs::read_dir(entry.path())? {
            let file = file?;
            let name = file.file_name().to_string_lossy().into_owned();
            let ours = is_definition(&name) || ["safetensors", "json", "csv"].iter().any(|e| has_extension(&name, e));
            if ours && file.file_type()?.is_file() {
                match read_bounded(&file.path()) {
                    Ok(bytes) => drop(files.insert(name, bytes)),
                    Err(reason) => unread.push(Unread { file: name, reason }),
                }
            }
        }
        folders.insert(entry.file_name().to_string_lossy().into_owned(), (files, unread));
    }
    Ok(folders)
}

/// A file that is no larger than any of ours can be; what is wrong with it otherwise.
fn read_bounded(path: &Path) -> Result<Vec<u8>, String> {
    let most = LARGEST_FILE_BYTES as u64;
    let cannot = |error: std::io::Error| format!("it cannot be read: {error}");
    let bytes = std::fs::metadata(path).map_err(cannot)?.len();
    if bytes > most {
        return Err(format!("it has {bytes} bytes, larger than the {most} that are read"));
    }
    std::fs::read(path).map_err(cannot)
}

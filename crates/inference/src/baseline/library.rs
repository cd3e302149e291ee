//! The library of structures and trained models: those embedded in the program, and those of a models folder.
//!
//! ```text
//!  DIR/<folder>/structure.toml (or .json)                 the structure
//!  DIR/<folder>/<name>.safetensors + <name>.json          a trained model of it
//! ```

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::model::Baseline;
use crate::flow::checkpoint::LARGEST_FILE_BYTES;
use structures::quantity::{Digest, StructureId};
use structures::simulator::definition::DefinitionError;
use structures::simulator::Simulator;

#[derive(rust_embed::Embed)]
#[folder = "../../models/"]
struct Shipped;

/// A structure of the library, with its trained model if one could be loaded.
#[derive(Clone)]
pub struct Entry {
    /// The structure.
    pub simulator: Simulator,
    /// Its trained model.
    pub baseline: Option<Arc<Baseline>>,
}

/// A file of the models folder that could not be read, and why.
struct Unread {
    file: String,
    reason: String,
}

/// A file that was found and refused.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, utoipa::ToSchema)]
pub struct Refusal {
    /// The file.
    pub file: String,
    /// The structure that it belongs to, if that could be determined.
    pub structure: Option<StructureId>,
    /// Why it was refused.
    pub reason: String,
}

/// All structures and trained models that were found.
#[derive(Clone, Default)]
pub struct Library {
    entries: BTreeMap<StructureId, Entry>,
    refusals: Vec<Refusal>,
    folder: Option<PathBuf>,
}

/// The two files of a trained model.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BaselineFiles {
    /// The manifest.
    pub manifest: Vec<u8>,
    /// The weights.
    pub weights: Vec<u8>,
    /// `program` for files embedded in the program, otherwise the folder.
    pub kept_in: String,
}

/// The models folder cannot be listed.
#[derive(Debug, thiserror::Error)]
#[error("the models folder {path} cannot be read: {source}")]
pub struct FolderError {
    path: PathBuf,
    source: std::io::Error,
}

/// Contents of the files of one folder of the library, by file name.
type Folder = BTreeMap<String, Vec<u8>>;

impl Library {
    /// Loads the embedded models and those of `folder`. A structure in `folder` replaces the embedded structure of the same
    /// id.
    ///
    /// A refused file is not an error: the other models are loaded, and [`Self::refusals`] gives the reason.
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

    /// Loads the embedded models and the same folder again.
    ///
    /// # Errors
    /// [`FolderError`] when the folder cannot be listed.
    pub fn read_again(&self) -> Result<Self, FolderError> {
        Self::open(self.folder.as_deref())
    }

    /// The models folder, if there is one.
    pub fn folder(&self) -> Option<&Path> {
        self.folder.as_deref()
    }

    /// The files of the model with this digest, if they still exist where they were read from.
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

    /// Adds the structure and model of a folder. Returns the id of the structure, if the folder has one.
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
                Ok(_) => self.refuse(
                    path,
                    Some(&id),
                    &"another model of this folder, whose name comes earlier in the alphabet, is in use",
                ),
                Err(error) => self.refuse(path, Some(&id), &error),
            }
        }
        self.entries.insert(id.clone(), Entry { simulator, baseline });
        Some(id)
    }

    /// Records that a file cannot be used.
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
        /// Ids of the shipped structures, as a suggestion.
        shipped: String,
    },
    /// The file is not a valid structure.
    #[error("{path}: {source}")]
    Definition {
        /// The file.
        path: PathBuf,
        /// The problems, each with its path in the file.
        source: DefinitionError,
    },
}

/// Reads a structure file: JSON with the extension `json`, otherwise TOML.
///
/// # Errors
/// [`StructureFileError`] with the file name and the path inside the file.
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

/// Finds a structure for the command line: a file, or the id of an embedded structure. An existing file takes precedence.
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

/// A text file of a folder that was read into memory.
fn in_folder(files: &Folder, file: &str) -> std::io::Result<String> {
    let bytes = files.get(file).ok_or_else(|| std::io::Error::from(std::io::ErrorKind::NotFound))?;
    String::from_utf8(bytes.clone()).map_err(|e| std::io::Error::new(std::io::ErrorKind::InvalidData, e))
}

/// Reads a structure file from memory; `beside` returns the text of another file in the same folder.
fn read_definition(
    name: &str,
    bytes: &[u8],
    beside: impl Fn(&str) -> std::io::Result<String>,
) -> Result<Simulator, DefinitionError> {
    let text = String::from_utf8_lossy(bytes);
    let is_json = Path::new(name).extension().is_some_and(|e| e.eq_ignore_ascii_case("json"));
    if is_json {
        Simulator::parse_json_beside(&text, beside)
    } else {
        Simulator::parse_toml_beside(&text, beside)
    }
}

fn has_extension(name: &str, extension: &str) -> bool {
    Path::new(name).extension().is_some_and(|found| found == extension)
}

/// Whether a file name is that of a structure file in a folder of the library.
fn is_definition(name: &str) -> bool {
    name == "structure.toml" || name == "structure.json"
}

/// The folders that are embedded in the program, by name.
fn shipped_folders() -> BTreeMap<String, Folder> {
    let mut folders = BTreeMap::<String, Folder>::new();
    for path in Shipped::iter() {
        if let (Some((folder, file)), Some(content)) = (path.split_once('/'), Shipped::get(&path)) {
            folders.entry(folder.to_owned()).or_default().insert(file.to_owned(), content.data.into_owned());
        }
    }
    folders
}

/// The files of a models folder by subfolder, and those that could not be read: one bad file must not prevent the service
/// from starting.
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

/// Reads a file unless it is larger than any model file can be; otherwise returns the reason.
fn read_bounded(path: &Path) -> Result<Vec<u8>, String> {
    let most = LARGEST_FILE_BYTES as u64;
    let cannot = |error: std::io::Error| format!("it cannot be read: {error}");
    let bytes = std::fs::metadata(path).map_err(cannot)?.len();
    if bytes > most {
        return Err(format!("it has {bytes} bytes, more than the {most} that are accepted"));
    }
    std::fs::read(path).map_err(cannot)
}

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
use crate::quantity::StructureId;
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

/// A file that was found and refused.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
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
        let mut library = Self::default();
        for (name, files) in shipped_folders() {
            library.add(&format!("shipped:{name}"), &files);
        }
        if let Some(path) = folder {
            let failed = |source| FolderError { path: path.to_owned(), source };
            for (name, files) in read_folders(path).map_err(failed)? {
                library.add(&path.join(name).display().to_string(), &files);
            }
        }
        Ok(library)
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

    fn add(&mut self, origin: &str, files: &Folder) {
        let Some((name, text)) = files.iter().find(|(name, _)| is_definition(name)) else {
            return;
        };
        let simulator = match read_definition(name, text, |file| in_folder(files, file)) {
            Ok(simulator) => simulator,
            Err(error) => return self.refuse(format!("{origin}/{name}"), None, &error),
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
        self.entries.insert(id, Entry { simulator, baseline });
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

fn read_folders(path: &Path) -> std::io::Result<BTreeMap<String, Folder>> {
    let mut folders = BTreeMap::new();
    for entry in std::fs::read_dir(path)? {
        let entry = entry?;
        if !entry.file_type()?.is_dir() {
            continue;
        }
        let mut files = Folder::new();
        for file in std::fs::read_dir(entry.path())? {
            let file = file?;
            let name = file.file_name().to_string_lossy().into_owned();
            let ours = is_definition(&name) || ["safetensors", "json", "csv"].iter().any(|e| has_extension(&name, e));
            if ours && file.file_type()?.is_file() {
                files.insert(name, std::fs::read(file.path())?);
            }
        }
        folders.insert(entry.file_name().to_string_lossy().into_owned(), files);
    }
    Ok(folders)
}

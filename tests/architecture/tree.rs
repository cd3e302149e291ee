//! The modules of a crate with their items and imports, and which file uses items of which other file.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use syn::visit::{self, Visit};

use crate::paths::{self, Mention};

/// A module: where it is, what it defines and what it imports. Modules and items of tests are excluded.
pub struct Module {
    pub file: usize,
    /// Names of the inline modules that lead to this one within its file.
    inner: Vec<String>,
    parent: Option<usize>,
    krate: usize,
    children: BTreeMap<String, usize>,
    items: BTreeSet<String>,
    /// Name in this module, and the path that it refers to.
    imports: BTreeMap<String, Vec<String>>,
    globs: Vec<Vec<String>>,
}

pub struct Tree {
    /// Path of each file below the root of the repository.
    pub files: Vec<String>,
    pub sources: Vec<syn::File>,
    pub modules: Vec<Module>,
    crates: BTreeMap<String, usize>,
}

/// The target of a path.
#[derive(Clone, Copy)]
pub enum Target {
    Module(usize),
    /// An item of this module.
    Item(usize),
}

/// One file uses an item that another file defines.
pub struct Edge {
    pub from: usize,
    pub to: usize,
    pub line: usize,
    pub path: String,
}

pub fn is_test(attributes: &[syn::Attribute]) -> bool {
    attributes.iter().any(|attribute| match &attribute.meta {
        syn::Meta::List(list) if list.path.is_ident("cfg") => {
            let condition = list.tokens.to_string();
            condition.contains("test") && !condition.contains("not")
        }
        meta => meta.path().is_ident("test"),
    })
}

impl Tree {
    /// The modules below each `(name, file)` of a crate, found by their `mod` declarations.
    pub fn read(root: &Path, crates: &[(&str, &str)]) -> Self {
        let (files, sources, modules) = (Vec::new(), Vec::new(), Vec::new());
        let mut tree = Self { files, sources, modules, crates: BTreeMap::new() };
        for (name, file) in crates {
            let folder = Path::new(file).parent().unwrap();
            let number = tree.modules.len();
            tree.crates.insert((*name).to_owned(), number);
            tree.read_file(root, Path::new(file), folder, None, number);
        }
        tree
    }

    /// `folder` is the folder of the children of this module.
    fn read_file(&mut self, root: &Path, file: &Path, folder: &Path, parent: Option<usize>, krate: usize) -> usize {
        let text = fs::read_to_string(root.join(file)).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
        let source = syn::parse_file(&text).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
        self.files.push(file.to_str().unwrap().to_owned());
        self.sources.push(source.clone());
        let module = self.add(self.files.len() - 1, Vec::new(), parent, krate);
        self.read_items(root, folder, module, &source.items);
        module
    }

    fn add(&mut self, file: usize, inner: Vec<String>, parent: Option<usize>, krate: usize) -> usize {
        let (children, items) = (BTreeMap::new(), BTreeSet::new());
        let (imports, globs) = (BTreeMap::new(), Vec::new());
        self.modules.push(Module { file, inner, parent, krate, children, items, imports, globs });
        self.modules.len() - 1
    }

    fn read_items(&mut self, root: &Path, folder: &Path, module: usize, items: &[syn::Item]) {
        for item in items {
            match item {
                syn::Item::Mod(item) if is_test(&item.attrs) => {}
                syn::Item::Mod(item) => {
                    let name = item.ident.to_string();
                    let krate = self.modules[module].krate;
                    let child = if let Some((_, items)) = &item.content {
                        let here = &self.modules[module];
                        let (file, inner) = (here.file, [&here.inner[..], std::slice::from_ref(&name)].concat());
                        let child = self.add(file, inner, Some(module), krate);
                        self.read_items(root, &folder.join(&name), child, items);
                        child
                    } else {
                        let (single, within) = (folder.join(format!("{name}.rs")), folder.join(&name));
                        let file = if root.join(&single).exists() { single } else { within.join("mod.rs") };
                        self.read_file(root, &file, &within, Some(module), krate)
                    };
                    self.modules[module].children.insert(name, child);
                }
                item => {
                    self.modules[module].items.extend(name_of(item).map(ToString::to_string));
                    let mut imports = Imports { module: &mut self.modules[module] };
                    imports.visit_item(item);
                }
            }
        }
    }

    /// Target of `path`, written in `module`; `None` for names that no crate of the tree defines.
    pub fn resolve(&self, module: usize, path: &[String], depth: usize) -> Option<Target> {
        let Some((first, rest)) = path.split_first() else { return Some(Target::Module(module)) };
        if depth > 16 {
            return None; // An import that names itself, as `use name::{self}` beside `mod name` may.
        }
        match first.as_str() {
            "crate" => self.below(self.modules[module].krate, rest, depth),
            "self" => self.below(module, rest, depth),
            "super" => self.resolve_from_parent(module, rest, depth),
            name => match self.lookup(module, name, rest, depth) {
                Some(target) => Some(target),
                None => self.crates.get(name).and_then(|&krate| self.below(krate, rest, depth)),
            },
        }
    }

    fn resolve_from_parent(&self, module: usize, rest: &[String], depth: usize) -> Option<Target> {
        let parent = self.modules[module].parent?;
        if rest.first().is_some_and(|next| next == "super") {
            self.resolve_from_parent(parent, &rest[1..], depth)
        } else {
            self.below(parent, rest, depth)
        }
    }

    /// Target of `path` inside a module; a name that a macro may have defined there is regarded as an item of that module.
    fn below(&self, module: usize, path: &[String], depth: usize) -> Option<Target> {
        match path.split_first() {
            None => Some(Target::Module(module)),
            Some((name, rest)) => self.lookup(module, name, rest, depth).or(Some(Target::Item(module))),
        }
    }

    fn lookup(&self, module: usize, name: &str, rest: &[String], depth: usize) -> Option<Target> {
        let here = &self.modules[module];
        let import = here.imports.get(name).filter(|import| *import != &[name.to_owned()]);
        if let Some(&child) = here.children.get(name) {
            let also_an_item = rest.is_empty() && (here.items.contains(name) || import.is_some());
            if !also_an_item {
                return self.below(child, rest, depth + 1);
            }
        }
        if here.items.contains(name) {
            return Some(Target::Item(module));
        }
        if let Some(import) = import {
            return self.resolve(module, &[import, rest].concat(), depth + 1);
        }
        here.globs.iter().find_map(|glob| match self.resolve(module, glob, depth + 1)? {
            Target::Module(other) if other != module => self.lookup(other, name, rest, depth + 1),
            _ => None,
        })
    }

    /// All uses of an item of one file by another. The import of a module alone is not a use, and neither is a public
    /// re-export of an item below the module that re-exports it.
    pub fn edges(&self) -> Vec<Edge> {
        let mentions = self.mentions();
        let edges = mentions.iter().filter_map(|(module, mention)| {
            let from = self.modules[*module].file;
            let to = match self.resolve(*module, &mention.path, 0)? {
                Target::Item(target) => {
                    let passed_on = mention.reexport && self.is_below(target, *module);
                    (!passed_on).then_some(self.modules[target].file)?
                }
                Target::Module(target) => mention.glob.then_some(self.modules[target].file)?,
            };
            let edge = Edge { from, to, line: mention.line, path: mention.path.join("::") };
            (from != to).then_some(edge)
        });
        edges.collect()
    }

    fn is_below(&self, module: usize, ancestor: usize) -> bool {
        module == ancestor || self.modules[module].parent.is_some_and(|parent| self.is_below(parent, ancestor))
    }

    /// Every path in the code, with the module it is written in.
    pub fn mentions(&self) -> Vec<(usize, Mention)> {
        let numbered = self.modules.iter().enumerate();
        let places: BTreeMap<(usize, &[String]), usize> =
            numbered.map(|(number, module)| ((module.file, &module.inner[..]), number)).collect();
        let sources = self.sources.iter().enumerate();
        let found = sources.flat_map(|(file, source)| {
            let found = paths::mentions(source).into_iter();
            found.map(|(inner, mention)| (places[&(file, &inner[..])], mention)).collect::<Vec<_>>()
        });
        found.collect()
    }

    /// The items of a module.
    pub fn items(&self, module: usize) -> &[syn::Item] {
        let module = &self.modules[module];
        module.inner.iter().fold(&self.sources[module.file].items, |items, name| {
            let mut inner = items.iter().filter_map(|item| match item {
                syn::Item::Mod(item) if item.ident == name => item.content.as_ref(),
                _ => None,
            });
            &inner.next().unwrap().1
        })
    }

    /// The line of an item's name; 0 if a macro defines the item.
    pub fn line_of(&self, module: usize, item: &str) -> usize {
        let names = self.items(module).iter().filter_map(name_of);
        names.into_iter().find(|name| *name == item).map_or(0, |name| name.span().start().line)
    }

    /// First module below the crate that a path from outside any other module names.
    pub fn top_module(&self, module: usize, path: &[String]) -> Option<String> {
        let climbs = path.iter().take_while(|segment| *segment == "super").count();
        let mut from = Some(module);
        for _ in 0..climbs {
            from = self.modules[from?].parent;
        }
        let absolute = path.first()? == "crate" || (climbs > 0 && self.modules[from?].parent.is_none());
        let name = if climbs > 0 { path.get(climbs)? } else { path.get(1)? };
        absolute.then(|| name.clone())
    }
}

fn name_of(item: &syn::Item) -> Option<&syn::Ident> {
    Some(match item {
        syn::Item::Const(item) => &item.ident,
        syn::Item::Enum(item) => &item.ident,
        syn::Item::Fn(item) => &item.sig.ident,
        syn::Item::Static(item) => &item.ident,
        syn::Item::Struct(item) => &item.ident,
        syn::Item::Trait(item) => &item.ident,
        syn::Item::Type(item) => &item.ident,
        syn::Item::Union(item) => &item.ident,
        syn::Item::Macro(item) => item.ident.as_ref()?,
        _ => return None,
    })
}

/// Collects the imports of a module, including those inside its functions.
struct Imports<'a> {
    module: &'a mut Module,
}

impl<'ast> Visit<'ast> for Imports<'_> {
    fn visit_item_use(&mut self, item: &'ast syn::ItemUse) {
        for leaf in paths::leaves(&item.tree) {
            match leaf.name {
                Some(name) => drop(self.module.imports.insert(name, leaf.path)),
                None => self.module.globs.push(leaf.path),
            }
        }
    }

    fn visit_item_mod(&mut self, _: &'ast syn::ItemMod) {}

    fn visit_item_fn(&mut self, item: &'ast syn::ItemFn) {
        if !is_test(&item.attrs) {
            visit::visit_item_fn(self, item);
        }
    }
}

/// All Rust files below a folder, as paths below `root`.
pub fn rust_files(root: &Path, folder: &str) -> Vec<PathBuf> {
    let Ok(entries) = fs::read_dir(root.join(folder)) else { return Vec::new() };
    let mut found = Vec::new();
    for path in entries.map(|entry| entry.unwrap().path()) {
        let below = path.strip_prefix(root).unwrap();
        if path.is_dir() {
            found.extend(rust_files(root, below.to_str().unwrap()));
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(below.to_owned());
        }
    }
    found.sort();
    found
}

//! Measures of the source tree: lengths of functions and files, methods of types, circles of files.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

use syn::visit::{self, Visit};

use crate::tree::{is_test, rust_files, Edge, Target, Tree};

pub struct Function {
    pub file: String,
    pub line: usize,
    pub name: String,
    /// From the line of `fn` to the closing brace.
    pub lines: usize,
    /// `self` included.
    pub parameters: usize,
}

/// Every function with a body outside the tests, longest first.
pub fn functions(tree: &Tree) -> Vec<Function> {
    let mut all = Vec::new();
    for (file, source) in tree.files.iter().zip(&tree.sources) {
        let mut reader = Functions { file, found: Vec::new() };
        reader.visit_file(source);
        all.extend(reader.found);
    }
    all.sort_by(|a, b| b.lines.cmp(&a.lines).then_with(|| a.file.cmp(&b.file)));
    all
}

struct Functions<'a> {
    file: &'a str,
    found: Vec<Function>,
}

impl Functions<'_> {
    fn add(&mut self, signature: &syn::Signature, body: &syn::Block) {
        let line = signature.fn_token.span.start().line;
        let lines = body.brace_token.span.close().end().line - line + 1;
        let (file, name) = (self.file.to_owned(), signature.ident.to_string());
        self.found.push(Function { file, line, name, lines, parameters: signature.inputs.len() });
    }
}

impl<'ast> Visit<'ast> for Functions<'_> {
    fn visit_item_mod(&mut self, item: &'ast syn::ItemMod) {
        if !is_test(&item.attrs) {
            visit::visit_item_mod(self, item);
        }
    }

    fn visit_item_fn(&mut self, item: &'ast syn::ItemFn) {
        if !is_test(&item.attrs) {
            self.add(&item.sig, &item.block);
            visit::visit_item_fn(self, item);
        }
    }

    fn visit_impl_item_fn(&mut self, item: &'ast syn::ImplItemFn) {
        if !is_test(&item.attrs) {
            self.add(&item.sig, &item.block);
            visit::visit_impl_item_fn(self, item);
        }
    }

    fn visit_trait_item_fn(&mut self, item: &'ast syn::TraitItemFn) {
        if let Some(body) = &item.default {
            self.add(&item.sig, body);
        }
        visit::visit_trait_item_fn(self, item);
    }
}

/// A type and its functions in `impl` blocks that implement no trait, in any file.
pub struct Type {
    /// The file that defines the type, and the line of its name there.
    pub file: String,
    pub line: usize,
    pub name: String,
    pub methods: usize,
    pub public: usize,
    pub files: BTreeSet<String>,
}

/// All types with methods, those with most first.
pub fn types(tree: &Tree) -> Vec<Type> {
    let mut found: BTreeMap<(String, String), Type> = BTreeMap::new();
    for (number, module) in tree.modules.iter().enumerate() {
        for item in tree.items(number) {
            let syn::Item::Impl(item) = item else { continue };
            if item.trait_.is_some() || is_test(&item.attrs) {
                continue;
            }
            let syn::Type::Path(path) = &*item.self_ty else { continue };
            let segments: Vec<String> = path.path.segments.iter().map(|s| s.ident.to_string()).collect();
            let Some(Target::Item(home)) = tree.resolve(number, &segments, 0) else { continue };
            let name = segments.last().unwrap().clone();
            let line = tree.line_of(home, &name);
            let home = tree.files[tree.modules[home].file].clone();
            let entry = found.entry((home.clone(), name.clone()));
            let entry = entry.or_insert(Type { file: home, line, name, methods: 0, public: 0, files: BTreeSet::new() });
            for method in &item.items {
                let syn::ImplItem::Fn(method) = method else { continue };
                if !is_test(&method.attrs) {
                    entry.methods += 1;
                    entry.public += usize::from(matches!(method.vis, syn::Visibility::Public(_)));
                    entry.files.insert(tree.files[module.file].clone());
                }
            }
        }
    }
    let mut types: Vec<Type> = found.into_values().collect();
    types.sort_by(|a, b| b.methods.cmp(&a.methods).then_with(|| a.file.cmp(&b.file)));
    types
}

/// Files below `folder` with their numbers of lines, longest first.
pub fn lengths(root: &Path, folder: &str) -> Vec<(String, usize)> {
    let length = |file: &Path| fs::read_to_string(root.join(file)).unwrap().lines().count();
    let files = rust_files(root, folder).into_iter();
    let mut lengths: Vec<_> = files.map(|file| (file.to_str().unwrap().to_owned(), length(&file))).collect();
    lengths.sort_by(|a, b| b.1.cmp(&a.1).then_with(|| a.0.cmp(&b.0)));
    lengths
}

/// Groups of files in which each file uses every other one, directly or through others of the group.
pub fn circles(edges: &[Edge]) -> Vec<Vec<usize>> {
    let mut next: BTreeMap<usize, BTreeSet<usize>> = BTreeMap::new();
    for edge in edges {
        next.entry(edge.from).or_default().insert(edge.to);
    }
    let reached = |from: usize| {
        let (mut seen, mut open) = (BTreeSet::new(), vec![from]);
        while let Some(file) = open.pop() {
            open.extend(next.get(&file).into_iter().flatten().filter(|other| seen.insert(**other)));
        }
        seen
    };
    let reach: BTreeMap<usize, BTreeSet<usize>> = next.keys().map(|&file| (file, reached(file))).collect();
    let mut circles: Vec<Vec<usize>> = Vec::new();
    for (&file, seen) in &reach {
        if seen.contains(&file) && !circles.iter().any(|circle| circle.contains(&file)) {
            let mutual = seen.iter().filter(|other| reach.get(other).is_some_and(|back| back.contains(&file)));
            circles.push(mutual.copied().collect());
        }
    }
    circles
}

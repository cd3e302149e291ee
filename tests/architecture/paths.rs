//! The paths that a source file contains: in `use` declarations, in code, in attributes and inside macros.

use proc_macro2::{TokenStream, TokenTree};
use syn::visit::{self, Visit};

use crate::tree::is_test;

/// A path as it is written.
pub struct Mention {
    pub path: Vec<String>,
    pub line: usize,
    pub reexport: bool,
    pub glob: bool,
}

/// One leaf of a `use` declaration: the path, and the name it gets here (none for `*`).
pub struct Leaf {
    pub path: Vec<String>,
    pub name: Option<String>,
    pub line: usize,
}

pub fn leaves(tree: &syn::UseTree) -> Vec<Leaf> {
    let mut found = Vec::new();
    collect_leaves(tree, &mut Vec::new(), &mut found);
    found
}

fn collect_leaves(tree: &syn::UseTree, before: &mut Vec<String>, found: &mut Vec<Leaf>) {
    let mut leaf = |ident: &syn::Ident, name: Option<&syn::Ident>| {
        let mut path = before.clone();
        if ident != "self" || path.is_empty() {
            path.push(ident.to_string());
        }
        let name = if ident == "self" && name.is_none() {
            path.last().cloned()
        } else {
            name.or(Some(ident)).map(ToString::to_string)
        };
        found.push(Leaf { path, name, line: ident.span().start().line });
    };
    match tree {
        syn::UseTree::Path(path) => {
            before.push(path.ident.to_string());
            collect_leaves(&path.tree, before, found);
            before.pop();
        }
        syn::UseTree::Name(name) => leaf(&name.ident, None),
        syn::UseTree::Rename(rename) => leaf(&rename.ident, Some(&rename.rename)),
        syn::UseTree::Glob(glob) => {
            let line = glob.star_token.spans[0].start().line;
            found.push(Leaf { path: before.clone(), name: None, line });
        }
        syn::UseTree::Group(group) => group.items.iter().for_each(|tree| collect_leaves(tree, before, found)),
    }
}

/// Each path in a file, with the names of the inline modules around it. Test code is excluded.
pub fn mentions(file: &syn::File) -> Vec<(Vec<String>, Mention)> {
    let mut reader = Reader { inner: Vec::new(), found: Vec::new() };
    reader.visit_file(file);
    reader.found
}

struct Reader {
    inner: Vec<String>,
    found: Vec<(Vec<String>, Mention)>,
}

impl Reader {
    fn add(&mut self, path: Vec<String>, line: usize) {
        self.found.push((self.inner.clone(), Mention { path, line, reexport: false, glob: false }));
    }

    /// The arguments of a macro are not parsed: names joined by `::` and single capitalised names are regarded as paths.
    fn tokens(&mut self, tokens: TokenStream) {
        let mut tokens = tokens.into_iter().peekable();
        let mut after_dot = false;
        while let Some(token) = tokens.next() {
            match token {
                TokenTree::Group(group) => self.tokens(group.stream()),
                TokenTree::Literal(literal) => self.literal(&literal),
                TokenTree::Ident(ident) => {
                    let line = ident.span().start().line;
                    let mut path = vec![ident.to_string()];
                    let colon = |token: &TokenTree| matches!(token, TokenTree::Punct(p) if p.as_char() == ':');
                    while tokens.peek().is_some_and(colon) {
                        tokens.next();
                        if !tokens.peek().is_some_and(colon) {
                            break;
                        }
                        tokens.next();
                        let Some(TokenTree::Ident(next)) = tokens.peek() else { break };
                        path.push(next.to_string());
                        tokens.next();
                    }
                    let capitalised = path[0].starts_with(char::is_uppercase);
                    if !after_dot && (path.len() > 1 || capitalised) {
                        self.add(path, line);
                    }
                    after_dot = false;
                    continue;
                }
                TokenTree::Punct(punct) => {
                    after_dot = punct.as_char() == '.';
                    continue;
                }
            }
            after_dot = false;
        }
    }

    /// Serde names functions by strings: `#[serde(with = "super::seconds")]`.
    fn literal(&mut self, literal: &proc_macro2::Literal) {
        let text = literal.to_string();
        let path = text.trim_matches('"').split("::").map(str::to_owned).collect::<Vec<_>>();
        let named = |segment: &String| !segment.is_empty() && segment.chars().all(|c| c.is_alphanumeric() || c == '_');
        if text.starts_with('"') && path.len() > 1 && path.iter().all(named) {
            self.add(path, literal.span().start().line);
        }
    }
}

impl<'ast> Visit<'ast> for Reader {
    fn visit_item(&mut self, item: &'ast syn::Item) {
        let attributes = match item {
            syn::Item::Const(item) => &item.attrs,
            syn::Item::Enum(item) => &item.attrs,
            syn::Item::Fn(item) => &item.attrs,
            syn::Item::Impl(item) => &item.attrs,
            syn::Item::Mod(item) => &item.attrs,
            syn::Item::Static(item) => &item.attrs,
            syn::Item::Struct(item) => &item.attrs,
            syn::Item::Trait(item) => &item.attrs,
            syn::Item::Type(item) => &item.attrs,
            syn::Item::Use(item) => &item.attrs,
            _ => return visit::visit_item(self, item),
        };
        if !is_test(attributes) {
            visit::visit_item(self, item);
        }
    }

    fn visit_impl_item_fn(&mut self, item: &'ast syn::ImplItemFn) {
        if !is_test(&item.attrs) {
            visit::visit_impl_item_fn(self, item);
        }
    }

    fn visit_item_mod(&mut self, item: &'ast syn::ItemMod) {
        if item.content.is_some() {
            self.inner.push(item.ident.to_string());
            visit::visit_item_mod(self, item);
            self.inner.pop();
        }
    }

    fn visit_item_use(&mut self, item: &'ast syn::ItemUse) {
        let reexport = !matches!(item.vis, syn::Visibility::Inherited);
        for leaf in leaves(&item.tree) {
            let mention =
                Mention { path: leaf.path, line: leaf.line, reexport, glob: leaf.name.is_none() && !reexport };
            self.found.push((self.inner.clone(), mention));
        }
    }

    fn visit_path(&mut self, path: &'ast syn::Path) {
        let segments = path.segments.iter().map(|segment| segment.ident.to_string()).collect();
        self.add(segments, path.segments[0].ident.span().start().line);
        visit::visit_path(self, path);
    }

    fn visit_macro(&mut self, item: &'ast syn::Macro) {
        visit::visit_macro(self, item);
        self.tokens(item.tokens.clone());
    }

    fn visit_attribute(&mut self, attribute: &'ast syn::Attribute) {
        if let syn::Meta::List(list) = &attribute.meta {
            self.tokens(list.tokens.clone());
        }
    }
}

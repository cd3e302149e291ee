//! Springs that a structure file may lack, and the stiffness of those that it has.

use std::collections::BTreeSet;

use structures::physics::{Form, Node, Spring, Structure};

/// With at most this many places, springs may be added between all pairs of them; with more, only between two places that have
/// a common neighbour.
const ALL_PAIRS_MASSES: usize = 12;

/// Greatest number of added springs that are considered.
const MOST_ADDED: usize = 400;

/// Stiffness of each spring that acts on translations only, N/m: between two places, or a place and the ground.
pub(super) fn translational_n_per_m(structure: &Structure) -> Vec<f64> {
    let translates = |node: &Node| match node {
        Node::Ground => true,
        Node::Dof(dof) => structure.attachment_points().iter().any(|point| point.dof == *dof),
    };
    let between = |s: &&Spring| matches!(&s.form, Form::Spring(a, b) if translates(a) && translates(b));
    structure.springs().iter().filter(between).map(|s| s.n_per_m).collect()
}

/// Pairs of nodes that no spring joins. Without a spring between two bodies, the file has a body for each mode, or for each of several
/// structures, and no part of one acts on another.
pub(super) fn missing_springs(structure: &Structure) -> Vec<(Node, Node)> {
    let places: Vec<usize> = structure.attachment_points().iter().map(|point| point.dof).collect();
    let joined = |a: Node, b: Node| {
        let ends = [Form::Spring(a, b), Form::Spring(b, a)];
        structure.springs().iter().any(|s| ends.contains(&s.form))
    };
    let mut neighbours = vec![BTreeSet::new(); structure.dofs()];
    for spring in structure.springs() {
        if let Form::Spring(Node::Dof(a), Node::Dof(b)) = spring.form {
            neighbours[a].insert(b);
            neighbours[b].insert(a);
        }
    }
    let alone = structure.springs().iter().all(|s| s.form.dofs().len() < 2);
    let near = |a: usize, b: usize| places.len() <= ALL_PAIRS_MASSES || !neighbours[a].is_disjoint(&neighbours[b]);
    let mut pairs = Vec::new();
    for (index, &a) in places.iter().enumerate() {
        if !joined(Node::Ground, Node::Dof(a)) {
            pairs.push((Node::Ground, Node::Dof(a)));
        }
        for &b in &places[index + 1..] {
            if !alone && !joined(Node::Dof(a), Node::Dof(b)) && near(a, b) {
                pairs.push((Node::Dof(a), Node::Dof(b)));
            }
        }
    }
    pairs.truncate(MOST_ADDED);
    pairs
}

//! Checks the definition of a beam structure and numbers its degrees of freedom.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::definition::{BeamDefinition, DefinitionProblem, StructureDefinition, Support};
use super::layout::{check_kg, check_names, check_spring, Layout, Problems};
use crate::physics::beam::{Element, Span};
use crate::physics::{AttachmentPoint, Form, Mass, Node};
use crate::quantity::shown;

/// Largest number of finite elements: the rounding error of the lowest frequency grows with the fourth power of their number.
pub(super) const MOST_ELEMENTS: usize = 200;

/// Degrees of freedom of a node, deflection and rotation; `None` where the support fixes them.
type NodeDofs = [Option<usize>; 2];

/// Degrees of freedom, masses and stiffness patterns of a beam structure; `None` if it has mistakes.
pub(super) fn layout(definition: &StructureDefinition, problems: &mut Problems) -> Option<Layout> {
    let before = problems.len();
    check_spans(definition, problems);
    if problems.len() > before {
        return None;
    }
    let mut dofs = 0;
    let mut next = |free: bool| {
        free.then(|| {
            dofs += 1;
            dofs - 1
        })
    };
    let mut nodes: BTreeMap<&str, NodeDofs> = BTreeMap::new();
    for node in &definition.nodes {
        let deflects = matches!(node.support, Support::Free | Support::Guided);
        let rotates = matches!(node.support, Support::Free | Support::Pinned);
        nodes.insert(&node.name, [next(deflects), next(rotates)]);
    }
    let spans: Vec<Arc<Span>> =
        definition.beams.iter().map(|beam| Arc::new(span(definition, beam, &nodes, &mut next))).collect();

    let names = definition.nodes.iter().map(|node| &node.name);
    let point = |name: &String| Some(AttachmentPoint { name: name.clone(), dof: nodes[name.as_str()][0]? });
    let attachment_points = names.filter_map(point).collect();
    let mut masses = bodies(definition, &nodes, problems);
    for (beam, span) in definition.beams.iter().zip(&spans) {
        let kg = beam.mass_kg_per_m * span.length_m();
        masses.push(Mass { name: beam.name.clone(), kg, form: Form::Inertia(span.clone()) });
    }
    let mut forms = springs(definition, &nodes, problems);
    forms.extend(spans.into_iter().map(Form::Bending));
    let modes = definition.modes;
    if modes > dofs {
        let message = format!("{modes} modes of a beam with {dofs} degrees of freedom: give its spans more elements");
        problems.push(DefinitionProblem::new("/modes", message));
    }
    (problems.len() == before).then_some(Layout { dofs, attachment_points, masses, forms })
}

/// Checks nodes, spans and names.
fn check_spans(definition: &StructureDefinition, problems: &mut Problems) {
    check_nodes(definition, problems);
    for (index, beam) in definition.beams.iter().enumerate() {
        check_beam(definition, beam, index, problems);
    }
    if definition.beams.is_empty() {
        problems.push(DefinitionProblem::new("/beam", "no [[beam]]: a simulation \"beam\" has at least one span"));
    }
    let elements = definition.beams.iter().fold(0, |sum: usize, b| sum.saturating_add(b.elements));
    if elements > MOST_ELEMENTS {
        let message = format!(
            "{elements} elements: at most {MOST_ELEMENTS} are allowed, and about three per half-wave are enough"
        );
        problems.push(DefinitionProblem::new("/beam", message));
    }
    check_names("mass", definition.masses.iter().map(|m| &m.name), problems);
    check_names("spring", definition.springs.iter().map(|s| &s.name), problems);
    check_names("beam", definition.beams.iter().map(|b| &b.name), problems);
    for (index, beam) in definition.beams.iter().enumerate() {
        let mut others = definition.masses.iter().map(|m| &m.name).chain(definition.springs.iter().map(|s| &s.name));
        if others.any(|name| *name == beam.name) {
            // A span is a mass and a stiffness at once: an effect could not say which of the two is meant.
            let message = format!("beam {} has the name of a mass or a spring: rename one", shown(&beam.name));
            problems.push(DefinitionProblem::new(format!("/beam/{index}/name"), message));
        }
    }
}

/// Checks the rigid bodies. Returns them, attached to their nodes.
fn bodies(definition: &StructureDefinition, nodes: &BTreeMap<&str, NodeDofs>, problems: &mut Problems) -> Vec<Mass> {
    let mut masses = Vec::new();
    for (index, mass) in definition.masses.iter().enumerate() {
        let at = mass.at.as_deref().unwrap_or_default();
        match nodes.get(at).map(|dofs| dofs[0]) {
            Some(Some(dof)) => masses.push(Mass::at(&mass.name, dof, mass.kg)),
            found => {
                let name = shown(&mass.name);
                let message = match found {
                    None if at.is_empty() => {
                        format!("mass {name} has no `at`: give the name of the node it is attached to")
                    }
                    None => format!("mass {name} is attached to {}, which is not a node", shown(at)),
                    Some(_) => {
                        format!("mass {name} is attached to a support that does not move: attach it to a free node")
                    }
                };
                problems.push(DefinitionProblem::new(format!("/mass/{index}/at"), message));
            }
        }
        check_kg(&mass.name, mass.kg, index, problems);
    }
    masses
}

/// Checks the nodes.
fn check_nodes(definition: &StructureDefinition, problems: &mut Problems) {
    check_names("node", definition.nodes.iter().map(|n| &n.name), problems);
    for (index, node) in definition.nodes.iter().enumerate() {
        if node.name == "ground" {
            let message = "a node cannot be called \"ground\": this name means the fixed end of springs";
            problems.push(DefinitionProblem::new(format!("/node/{index}/name"), message));
        }
        if !node.x_m.is_finite() {
            problems.push(DefinitionProblem::new(
                format!("/node/{index}/x_m"),
                format!("a position of {} m is not finite", node.x_m),
            ));
        }
        let used = definition.beams.iter().any(|b| b.from == node.name || b.to == node.name);
        if !used {
            let message = format!("node {} is not an end of any beam: connect it, or remove it", shown(&node.name));
            problems.push(DefinitionProblem::new(format!("/node/{index}/name"), message));
        }
    }
}

/// Checks one span.
fn check_beam(definition: &StructureDefinition, beam: &BeamDefinition, index: usize, problems: &mut Problems) {
    let mut wrong = |key: &str, message: String| {
        problems.push(DefinitionProblem::new(format!("/beam/{index}/{key}"), message));
    };
    let name = shown(&beam.name);
    let x_m = |node: &str| definition.nodes.iter().find(|n| n.name == node).map(|n| n.x_m);
    for (key, node) in [("from", &beam.from), ("to", &beam.to)] {
        if x_m(node).is_none() {
            wrong(key, format!("beam {name} goes to {}, which is not a node", shown(node)));
        }
    }
    if let (Some(from), Some(to)) = (x_m(&beam.from), x_m(&beam.to)) {
        // This form of the condition also rejects NaN.
        let long = (to - from).abs() > 0.0;
        if !long {
            wrong("to", format!("beam {name} has no length, because both ends are at {from} m: move one of its nodes"));
        }
    }
    if !(beam.mass_kg_per_m.is_finite() && beam.mass_kg_per_m > 0.0) {
        wrong("mass_kg_per_m", format!("beam {name} has {} kg/m: it must be finite and above 0", beam.mass_kg_per_m));
    }
    if let Some(stiffness) = beam.bending_stiffness_n_m2.filter(|k| !(k.is_finite() && *k > 0.0)) {
        let message = format!("beam {name} has a bending stiffness of {stiffness} N·m²: it must be finite and above 0");
        wrong("bending_stiffness_n_m2", message);
    }
    if beam.elements == 0 || beam.elements > MOST_ELEMENTS {
        wrong("elements", format!("beam {name} has {} elements: at least one, at most {MOST_ELEMENTS}", beam.elements));
    }
}

/// A span of equal elements between two nodes. Both degrees of freedom of its interior nodes are free; `next` numbers them.
fn span(
    definition: &StructureDefinition,
    beam: &BeamDefinition,
    nodes: &BTreeMap<&str, NodeDofs>,
    next: &mut impl FnMut(bool) -> Option<usize>,
) -> Span {
    let x_m = |node: &str| definition.nodes.iter().find(|n| n.name == node).map_or(0.0, |n| n.x_m);
    // From left to right, so that the rotations of neighbouring spans have the same sign.
    let (left, right) = if x_m(&beam.from) < x_m(&beam.to) { (&beam.from, &beam.to) } else { (&beam.to, &beam.from) };
    let length_m = (x_m(right) - x_m(left)) / beam.elements as f64;
    let mut start = nodes[left.as_str()];
    let elements = (1..=beam.elements).map(|element| {
        let end = if element == beam.elements { nodes[right.as_str()] } else { [next(true), next(true)] };
        let dofs = [start[0], start[1], end[0], end[1]];
        start = end;
        Element { dofs, length_m, factor: 1.0 }
    });
    Span { elements: elements.collect(), start_m: x_m(left) }
}

/// Checks the springs. Returns the stiffness pattern of each.
fn springs(definition: &StructureDefinition, nodes: &BTreeMap<&str, NodeDofs>, problems: &mut Problems) -> Vec<Form> {
    let mut forms = Vec::new();
    for (index, spring) in definition.springs.iter().enumerate() {
        let rotation = spring.n_m_per_rad.is_some();
        let mut node = |key: &str, name: &str| {
            if name == "ground" {
                return Node::Ground;
            }
            let wrong = match nodes.get(name) {
                None => "which is neither a node nor \"ground\"",
                Some(dofs) => match dofs[usize::from(rotation)] {
                    Some(dof) => return Node::Dof(dof),
                    None => "but its support fixes this degree of freedom already",
                },
            };
            let message = format!("spring {} goes to {}, {wrong}", shown(&spring.name), shown(name));
            problems.push(DefinitionProblem::new(format!("/spring/{index}/{key}"), message));
            Node::Ground
        };
        forms.push(Form::Spring(node("from", &spring.from), node("to", &spring.to)));
        check_spring(spring, index, problems);
        if rotation && spring.n_per_m.is_some() {
            let message =
                "a spring has either a translational stiffness, n_per_m, or a rotational one, n_m_per_rad: not both";
            problems.push(DefinitionProblem::new(format!("/spring/{index}/n_m_per_rad"), message));
        }
    }
    forms
}

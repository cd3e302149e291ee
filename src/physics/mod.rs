//! Structures without networks: masses, springs and beams, and their natural frequencies.

pub mod assembly;
pub mod beam;
pub mod effect;
pub mod eigen;
pub mod modes;
pub mod shapes;
pub mod side_by_side;

use std::collections::BTreeSet;
use std::sync::Arc;

use beam::Span;
pub use modes::{
    frequency_sensitivity, modes, natural_frequencies_hz, natural_frequencies_with, FrequencySensitivity, Modes,
};

/// A mass: a body, or what a span of a beam weighs.
#[derive(Debug, Clone, PartialEq)]
pub struct Mass {
    /// Unique name.
    pub name: String,
    /// Mass, kg.
    pub kg: f64,
    /// Where it moves.
    pub form: Form,
}

impl Mass {
    /// A body that moves with one degree of freedom.
    pub fn at(name: impl Into<String>, freedom: usize, kg: f64) -> Self {
        Self { name: name.into(), kg, form: Form::Spring(Node::Ground, Node::Freedom(freedom)) }
    }
}

/// An end of a spring.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Node {
    /// Fixed.
    Ground,
    /// A degree of freedom by its index: in a structure of masses and springs, the mass of that index.
    Freedom(usize),
}

/// The matrix that a unit of stiffness or of mass adds.
#[derive(Debug, Clone, PartialEq)]
pub enum Form {
    /// (e_a − e_b)(e_a − e_b)ᵀ, e = 0 for the ground: a spring between two nodes, or a body at one.
    Spring(Node, Node),
    /// Bending of a span of beam elements.
    Bending(Arc<Span>),
    /// Inertia of such a span, spread evenly.
    Inertia(Arc<Span>),
}

impl Form {
    /// Calls `entry(row, column, value)` for every entry of the matrix; one place may come several times.
    pub fn entries(&self, mut entry: impl FnMut(usize, usize, f64)) {
        match self {
            Self::Spring(a, b) => {
                let ends = [(a, 1.0), (b, -1.0)].map(|(node, sign)| match node {
                    Node::Ground => None,
                    Node::Freedom(freedom) => Some((*freedom, sign)),
                });
                for (row, left) in ends.iter().flatten() {
                    for (column, right) in ends.iter().flatten() {
                        entry(*row, *column, left * right);
                    }
                }
            }
            Self::Bending(span) => span.bending(entry),
            Self::Inertia(span) => span.inertia(entry),
        }
    }

    fn freedoms(&self) -> BTreeSet<usize> {
        let mut all = BTreeSet::new();
        self.entries(|row, column, _| all.extend([row, column]));
        all
    }
}

/// A stiffness: a linear spring, or the bending stiffness of a span of a beam.
#[derive(Debug, Clone, PartialEq)]
pub struct Spring {
    /// Unique name.
    pub name: String,
    /// Where it acts.
    pub form: Form,
    /// Stiffness: N/m; N·m/rad where it holds a rotation; bending stiffness EI in N·m² for a span.
    pub n_per_m: f64,
}

impl Spring {
    /// A spring between two nodes.
    pub fn between(name: impl Into<String>, from: Node, to: Node, n_per_m: f64) -> Self {
        Self { name: name.into(), form: Form::Spring(from, to), n_per_m }
    }
}

/// A named place that moves sideways: springs and bodies can be attached to it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Place {
    /// Unique name.
    pub name: String,
    /// Its degree of freedom.
    pub freedom: usize,
}

/// Masses and stiffnesses that hold together.
#[derive(Debug, Clone, PartialEq)]
pub struct Structure {
    freedoms: usize,
    places: Arc<[Place]>,
    masses: Vec<Mass>,
    springs: Vec<Spring>,
}

/// Why something is no structure, or has no natural frequencies.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// Nothing that could vibrate.
    #[error("a structure needs at least one mass")]
    NoMass,
    /// Two masses or two springs of the same name.
    #[error("the name \"{0}\" is used twice")]
    DuplicateName(String),
    /// A mass that is not positive.
    #[error("mass \"{name}\" has {kg} kg: it must be finite and above 0")]
    Mass {
        /// Name of the mass.
        name: String,
        /// Its value, kg.
        kg: f64,
    },
    /// A stiffness that is negative or not finite.
    #[error("spring \"{name}\" has a stiffness of {n_per_m} N/m: it must be finite and not negative")]
    Stiffness {
        /// Name of the spring.
        name: String,
        /// Its value, N/m.
        n_per_m: f64,
    },
    /// A spring whose two ends are the same.
    #[error("spring \"{name}\" goes from a node to itself")]
    Loop {
        /// Name of the spring.
        name: String,
    },
    /// A spring to a mass that does not exist.
    #[error("spring \"{name}\" goes to mass number {index} of {masses}")]
    UnknownMass {
        /// Name of the spring.
        name: String,
        /// Index asked for.
        index: usize,
        /// Masses there are.
        masses: usize,
    },
    /// A mass that no chain of springs ties to the ground.
    #[error(
        "mass \"{mass}\" is not tied to the ground by springs of positive stiffness: the structure is a mechanism"
    )]
    Mechanism {
        /// Name of a floating mass.
        mass: String,
    },
    /// An effect so large that hardly any stiffness, mass or frequency is left.
    #[error("effect number {number} has a size of {size}: it leaves less than a fiftieth of what it acts on")]
    Effect {
        /// Index of the effect.
        number: usize,
        /// Its size.
        size: f64,
    },
    /// A degree of freedom that nothing gives a mass.
    #[error("a degree of freedom has no mass: it has no natural frequency")]
    Massless,
    /// More modes than degrees of freedom.
    #[error("asked for {asked} modes of a structure with {available}")]
    TooFewModes {
        /// Modes asked for.
        asked: usize,
        /// Degrees of freedom.
        available: usize,
    },
    /// Tied to the ground so weakly that the smallest eigenvalue drowns in rounding.
    #[error("the smallest eigenvalue is {smallest} rad²/s², the largest {largest}: numerically a mechanism")]
    NearMechanism {
        /// Smallest eigenvalue, rad²/s².
        smallest: f64,
        /// Largest eigenvalue, rad²/s².
        largest: f64,
    },
}

impl Structure {
    /// Checks a structure of bodies on springs: one degree of freedom for each mass, in their order.
    ///
    /// # Errors
    /// [`Error`], one variant for each way they can be wrong.
    pub fn new(masses: Vec<Mass>, springs: Vec<Spring>) -> Result<Self, Error> {
        let place = |(freedom, mass): (usize, &Mass)| Place { name: mass.name.clone(), freedom };
        let places = masses.iter().enumerate().map(place).collect();
        let structure = Self::with_freedoms(masses.len(), places, masses, springs)?;
        let tied = structure.springs.iter().filter(|s| s.n_per_m > 0.0);
        if let Some(index) = floating_mass(structure.freedoms, tied) {
            return Err(Error::Mechanism { mass: structure.masses[index].name.clone() });
        }
        Ok(structure)
    }

    /// Checks a structure of any forms over `freedoms` degrees of freedom. Whether it is tied to the ground shows in its
    /// eigenvalues.
    ///
    /// # Errors
    /// As [`Self::new`], but for [`Error::Mechanism`].
    pub fn with_freedoms(
        freedoms: usize,
        places: Vec<Place>,
        masses: Vec<Mass>,
        springs: Vec<Spring>,
    ) -> Result<Self, Error> {
        if freedoms == 0 || masses.is_empty() {
            return Err(Error::NoMass);
        }
        if let Some(mass) = masses.iter().find(|m| !(m.kg.is_finite() && m.kg > 0.0)) {
            return Err(Error::Mass { name: mass.name.clone(), kg: mass.kg });
        }
        unique(masses.iter().map(|m| &m.name))?;
        unique(springs.iter().map(|s| &s.name))?;
        for spring in &springs {
            let name = || spring.name.clone();
            check_stiffness(spring, spring.n_per_m)?;
            if matches!(&spring.form, Form::Spring(from, to) if from == to) {
                return Err(Error::Loop { name: name() });
            }
            if let Some(&index) = spring.form.freedoms().iter().find(|index| **index >= freedoms) {
                return Err(Error::UnknownMass { name: name(), index, masses: freedoms });
            }
        }
        for mass in &masses {
            if let Some(&index) = mass.form.freedoms().iter().find(|index| **index >= freedoms) {
                return Err(Error::UnknownMass { name: mass.name.clone(), index, masses: freedoms });
            }
        }
        Ok(Self { freedoms, places: places.into(), masses, springs })
    }

    /// Number of degrees of freedom.
    pub fn freedoms(&self) -> usize {
        self.freedoms
    }

    /// Places that move sideways, to which something can be attached.
    pub fn places(&self) -> &[Place] {
        &self.places
    }

    /// Name of a node.
    ///
    /// # Panics
    /// When it is no place of this structure: a bug.
    pub fn node_name(&self, node: Node) -> &str {
        match node {
            Node::Ground => "ground",
            Node::Freedom(freedom) => {
                let place = self.places.iter().find(|place| place.freedom == freedom);
                &place.expect("only places are named").name
            }
        }
    }

    /// Mean mass of a place, kg: of the body there, or of the whole structure over its places.
    pub fn kg_at(&self, freedom: usize) -> f64 {
        let here = Form::Spring(Node::Ground, Node::Freedom(freedom));
        let body = self.masses.iter().find(|m| m.form == here).map(|m| m.kg);
        body.unwrap_or_else(|| self.masses.iter().map(|m| m.kg).sum::<f64>() / self.places.len().max(1) as f64)
    }

    /// The masses; in a structure of bodies on springs, in the order of the degrees of freedom.
    pub fn masses(&self) -> &[Mass] {
        &self.masses
    }

    /// The springs.
    pub fn springs(&self) -> &[Spring] {
        &self.springs
    }

    /// The same structure with other stiffnesses, given as (index of the spring, N/m).
    ///
    /// Cheap: only what changes is checked. A stiffness of zero that cuts a mass off shows in the eigenvalues.
    ///
    /// # Errors
    /// [`Error::Stiffness`].
    pub fn with_stiffness(&self, changes: &[(usize, f64)]) -> Result<Self, Error> {
        self.check_changes(changes)?;
        let mut changed = self.clone();
        for &(index, n_per_m) in changes {
            changed.springs[index].n_per_m = n_per_m;
        }
        Ok(changed)
    }

    fn check_changes(&self, changes: &[(usize, f64)]) -> Result<(), Error> {
        changes.iter().try_for_each(|(index, n_per_m)| check_stiffness(&self.springs[*index], *n_per_m))
    }
}

fn check_stiffness(spring: &Spring, n_per_m: f64) -> Result<(), Error> {
    let valid = n_per_m.is_finite() && n_per_m >= 0.0;
    valid.then_some(()).ok_or_else(|| Error::Stiffness { name: spring.name.clone(), n_per_m })
}

fn unique<'a>(names: impl Iterator<Item = &'a String>) -> Result<(), Error> {
    let mut seen = BTreeSet::new();
    names.into_iter().find(|name| !seen.insert(*name)).map_or(Ok(()), |name| Err(Error::DuplicateName(name.clone())))
}

/// Index of a mass that `springs` do not tie to the ground, if there is one.
///
/// Springs are one-dimensional, so K is the Laplacian of a weighted graph with a grounded node: it is singular exactly
/// when a part of the graph has no way to the ground.
pub fn floating_mass<'a>(masses: usize, springs: impl Iterator<Item = &'a Spring>) -> Option<usize> {
    let ground = masses;
    let mut neighbours = vec![Vec::new(); masses + 1];
    let index = |node: Node| match node {
        Node::Ground => ground,
        Node::Freedom(index) => index,
    };
    for spring in springs {
        let Form::Spring(from, to) = &spring.form else { continue };
        let (from, to) = (index(*from), index(*to));
        neighbours[from].push(to);
        neighbours[to].push(from);
    }
    let mut reached = vec![false; masses + 1];
    let mut open = vec![ground];
    while let Some(node) = open.pop() {
        if !std::mem::replace(&mut reached[node], true) {
            open.extend(&neighbours[node]);
        }
    }
    reached[..masses].iter().position(|tied| !tied)
}

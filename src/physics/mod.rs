//! Structures without networks: masses and springs, and their natural frequencies.

pub mod assembly;
pub mod effect;
pub mod modes;

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};

pub use modes::{frequency_sensitivity, modes, natural_frequencies_hz, FrequencySensitivity, Modes};

/// A rigid body with one degree of freedom.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Mass {
    /// Unique name.
    pub name: String,
    /// Mass, kg.
    pub kg: f64,
}

/// An end of a spring.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Node {
    /// Fixed.
    Ground,
    /// A mass by its index.
    Mass(usize),
}

/// A linear spring between two nodes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Spring {
    /// Unique name.
    pub name: String,
    /// One end.
    pub from: Node,
    /// The other end.
    pub to: Node,
    /// Stiffness, N/m.
    pub n_per_m: f64,
}

/// Masses and springs that hold together: every mass is tied to the ground.
#[derive(Debug, Clone, PartialEq)]
pub struct Structure {
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
    /// Checks masses and springs.
    ///
    /// # Errors
    /// [`Error`], one variant for each way they can be wrong.
    pub fn new(masses: Vec<Mass>, springs: Vec<Spring>) -> Result<Self, Error> {
        if masses.is_empty() {
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
            if spring.from == spring.to {
                return Err(Error::Loop { name: name() });
            }
            for end in [spring.from, spring.to] {
                if let Node::Mass(index) = end {
                    if index >= masses.len() {
                        return Err(Error::UnknownMass { name: name(), index, masses: masses.len() });
                    }
                }
            }
        }
        if let Some(index) = floating_mass(masses.len(), springs.iter().filter(|s| s.n_per_m > 0.0)) {
            return Err(Error::Mechanism { mass: masses[index].name.clone() });
        }
        Ok(Self { masses, springs })
    }

    /// The masses, in the order of the degrees of freedom.
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
        let mut changed = self.clone();
        for &(index, n_per_m) in changes {
            check_stiffness(&changed.springs[index], n_per_m)?;
            changed.springs[index].n_per_m = n_per_m;
        }
        Ok(changed)
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
        Node::Mass(index) => index,
    };
    for spring in springs {
        let (from, to) = (index(spring.from), index(spring.to));
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

//! Structures of masses, springs and beams, and what acts on them.

use std::collections::BTreeSet;
use std::sync::Arc;

use nalgebra::DMatrix;

use super::beam::Span;

/// A mass: a rigid body, or the distributed mass of a beam span.
#[derive(Debug, Clone, PartialEq)]
pub struct Mass {
    /// Unique name.
    pub name: String,
    /// Mass, kg.
    pub kg: f64,
    /// Pattern of the mass matrix.
    pub form: Form,
}

impl Mass {
    /// A rigid body that moves with the degree of freedom `dof`.
    pub fn at(name: impl Into<String>, dof: usize, kg: f64) -> Self {
        Self { name: name.into(), kg, form: Form::Spring(Node::Ground, Node::Dof(dof)) }
    }
}

/// One end of a spring.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Node {
    /// The fixed ground.
    Ground,
    /// A degree of freedom (DOF) by its index. In a structure of masses and springs this is the index of the mass.
    Dof(usize),
}

/// Pattern of one part: the matrix that a unit of its stiffness or mass adds to K or M.
#[derive(Debug, Clone, PartialEq)]
pub enum Form {
    /// (e_a − e_b)(e_a − e_b)ᵀ with e = 0 for the ground: a spring between two nodes, or a rigid body at one node.
    Spring(Node, Node),
    /// Bending stiffness of a beam span.
    Bending(Arc<Span>),
    /// Evenly distributed mass of a beam span.
    Inertia(Arc<Span>),
    /// The integral of the squared slope over a beam span: a tension, or a rotary inertia.
    Slope(Arc<Span>),
    /// The change of the mass matrix where the mass of a rigid body at the degree of freedom is spread evenly over the distance to a node:
    /// 1/3 e_a e_aᵀ + 1/6 (e_a e_bᵀ + e_b e_aᵀ) + (1/3 − 1) e_b e_bᵀ, with e_a = 0 for the ground.
    Spread(Node, usize),
}

impl Form {
    /// Calls `entry(row, column, value)` for every contribution to the matrix. Contributions to the same entry are summed.
    pub fn entries(&self, mut entry: impl FnMut(usize, usize, f64)) {
        match self {
            Self::Spring(a, b) => {
                let ends = [(a, 1.0), (b, -1.0)].map(|(node, sign)| match node {
                    Node::Ground => None,
                    Node::Dof(dof) => Some((*dof, sign)),
                });
                for (row, left) in ends.iter().flatten() {
                    for (column, right) in ends.iter().flatten() {
                        entry(*row, *column, left * right);
                    }
                }
            }
            Self::Bending(span) => span.bending(entry),
            Self::Inertia(span) => span.inertia(entry),
            Self::Slope(span) => span.slope(entry),
            Self::Spread(before, dof) => {
                entry(*dof, *dof, 1.0 / 3.0 - 1.0);
                if let Node::Dof(before) = before {
                    entry(*before, *before, 1.0 / 3.0);
                    entry(*before, *dof, 1.0 / 6.0);
                    entry(*dof, *before, 1.0 / 6.0);
                }
            }
        }
    }

    /// Degrees of freedom that the part acts on.
    pub fn dofs(&self) -> BTreeSet<usize> {
        let mut all = BTreeSet::new();
        self.entries(|row, column, _| all.extend([row, column]));
        all
    }
}

/// A stiffness: a linear spring, or the bending stiffness of a beam span.
#[derive(Debug, Clone, PartialEq)]
pub struct Spring {
    /// Unique name.
    pub name: String,
    /// Pattern of the stiffness matrix.
    pub form: Form,
    /// Stiffness: in N/m for a translational spring, in N·m/rad for a rotational spring, EI in N·m² for a beam span.
    pub n_per_m: f64,
}

impl Spring {
    /// A spring between two nodes.
    pub fn between(name: impl Into<String>, from: Node, to: Node, n_per_m: f64) -> Self {
        Self { name: name.into(), form: Form::Spring(from, to), n_per_m }
    }
}

/// A named point that can deflect, to which springs and bodies can be attached.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AttachmentPoint {
    /// Unique name.
    pub name: String,
    /// Degree of freedom of its deflection.
    pub dof: usize,
}

/// A checked structure of masses and stiffnesses.
#[derive(Debug, Clone, PartialEq)]
pub struct Structure {
    pub(super) dofs: usize,
    pub(super) attachment_points: Arc<[AttachmentPoint]>,
    pub(super) masses: Vec<Mass>,
    pub(super) springs: Vec<Spring>,
    /// Flexibilities in series with the springs: K⁻¹ → K⁻¹ + g B, with g and B, `[n, n]`.
    pub(super) flexibilities: Vec<(f64, Arc<DMatrix<f64>>)>,
    /// Distance of each degree of freedom from the ground, m, if given.
    pub(super) positions_m: Option<Arc<[f64]>>,
}

/// Why the parts do not form a valid structure, or why its natural frequencies cannot be computed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// There are no masses or no degrees of freedom.
    #[error("a structure needs at least one mass")]
    NoMass,
    /// Two masses or two springs have the same name.
    #[error("the name \"{0}\" is used twice")]
    DuplicateName(String),
    /// A mass is not finite and positive.
    #[error("mass \"{name}\" has {kg} kg: it must be finite and above 0")]
    Mass {
        /// Name of the mass.
        name: String,
        /// Its value, kg.
        kg: f64,
    },
    /// A stiffness is negative or not finite.
    #[error("spring \"{name}\" has a stiffness of {n_per_m} N/m: it must be finite and not negative")]
    Stiffness {
        /// Name of the spring.
        name: String,
        /// Its value, N/m.
        n_per_m: f64,
    },
    /// Both ends of a spring are the same node.
    #[error("spring \"{name}\" has both ends at the same node: it needs two different ends")]
    Loop {
        /// Name of the spring.
        name: String,
    },
    /// A part refers to a degree of freedom that does not exist.
    #[error("\"{name}\" refers to degree of freedom {index}, but there are only {masses}, counted from 0")]
    UnknownMass {
        /// Name of the spring or mass.
        name: String,
        /// Index asked for.
        index: usize,
        /// Number of degrees of freedom.
        masses: usize,
    },
    /// No chain of springs connects a mass to the ground.
    #[error(
        "mass \"{mass}\" is not connected to the ground by springs of positive stiffness: the structure is a mechanism"
    )]
    Mechanism {
        /// Name of a mass that is not connected to the ground.
        mass: String,
    },
    /// An effect leaves less than 2 % of the stiffness, mass or frequency that it acts on, or cannot act on this simulation.
    #[error("effect number {number} has a size of {size}: it must leave at least 2 % of the quantity that it acts on")]
    Effect {
        /// Index of the effect.
        number: usize,
        /// Its size.
        size: f64,
    },
    /// A degree of freedom has no mass.
    #[error("a degree of freedom has no mass: the mass matrix must be positive definite")]
    Massless,
    /// More modes were asked for than the simulation has.
    #[error("asked for {asked} modes of a structure with {available}")]
    TooFewModes {
        /// Modes asked for.
        asked: usize,
        /// Modes that the simulation has.
        available: usize,
    },
    /// The smallest eigenvalue is within rounding of zero, relative to the largest.
    #[error("the smallest eigenvalue is {smallest} rad²/s², the largest {largest}: numerically a mechanism")]
    NearMechanism {
        /// Smallest eigenvalue, rad²/s².
        smallest: f64,
        /// Largest eigenvalue, rad²/s².
        largest: f64,
    },
}

impl Structure {
    /// Builds and checks a structure of rigid bodies on springs, with one degree of freedom for each mass, in their order.
    ///
    /// # Errors
    /// [`Error`] for an invalid mass, spring or name, and [`Error::Mechanism`] for a mass that is not connected to the ground.
    pub fn new(masses: Vec<Mass>, springs: Vec<Spring>) -> Result<Self, Error> {
        let point = |(dof, mass): (usize, &Mass)| AttachmentPoint { name: mass.name.clone(), dof };
        let points = masses.iter().enumerate().map(point).collect();
        let structure = Self::with_dofs(masses.len(), points, masses, springs)?;
        let stiff = structure.springs.iter().filter(|s| s.n_per_m > 0.0);
        if let Some(index) = floating_mass(structure.dofs, stiff) {
            return Err(Error::Mechanism { mass: structure.masses[index].name.clone() });
        }
        Ok(structure)
    }

    /// Builds and checks a structure of any parts over `dofs` degrees of freedom. Whether it is a mechanism is only detected
    /// when its eigenvalues are computed.
    ///
    /// # Errors
    /// As [`Self::new`], except [`Error::Mechanism`].
    pub fn with_dofs(
        dofs: usize,
        attachment_points: Vec<AttachmentPoint>,
        masses: Vec<Mass>,
        springs: Vec<Spring>,
    ) -> Result<Self, Error> {
        if dofs == 0 || masses.is_empty() {
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
            if let Some(&index) = spring.form.dofs().iter().find(|index| **index >= dofs) {
                return Err(Error::UnknownMass { name: name(), index, masses: dofs });
            }
        }
        for mass in &masses {
            if let Some(&index) = mass.form.dofs().iter().find(|index| **index >= dofs) {
                return Err(Error::UnknownMass { name: mass.name.clone(), index, masses: dofs });
            }
        }
        Ok(Self {
            dofs,
            attachment_points: attachment_points.into(),
            masses,
            springs,
            flexibilities: Vec::new(),
            positions_m: None,
        })
    }

    /// The same structure with the distance of each degree of freedom from the ground, m, `[n]`.
    #[must_use]
    pub fn with_positions(self, positions_m: Vec<f64>) -> Self {
        Self { positions_m: Some(positions_m.into()), ..self }
    }

    /// The same structure with further springs, which are not checked.
    #[must_use]
    pub fn with_springs(mut self, further: impl IntoIterator<Item = Spring>) -> Self {
        self.springs.extend(further);
        self
    }

    /// Whether flexibilities are in series with the springs, so that K is not linear in the stiffnesses.
    pub fn is_in_series(&self) -> bool {
        !self.flexibilities.is_empty()
    }

    /// Number of degrees of freedom n.
    pub fn dofs(&self) -> usize {
        self.dofs
    }

    /// Points that can deflect, to which springs and bodies can be attached.
    pub fn attachment_points(&self) -> &[AttachmentPoint] {
        &self.attachment_points
    }

    /// Name of a node.
    ///
    /// # Panics
    /// If no attachment point has this degree of freedom, which is a programming error in the caller.
    pub fn node_name(&self, node: Node) -> &str {
        match node {
            Node::Ground => "ground",
            Node::Dof(dof) => {
                let point = self.attachment_points.iter().find(|point| point.dof == dof);
                &point.expect("only attachment points have names").name
            }
        }
    }

    /// Typical mass at an attachment point, kg: that of the body there, or else the total mass of the structure divided by the
    /// number of its attachment points.
    pub fn kg_at(&self, dof: usize) -> f64 {
        let here = Form::Spring(Node::Ground, Node::Dof(dof));
        let body = self.masses.iter().find(|m| m.form == here).map(|m| m.kg);
        body.unwrap_or_else(|| {
            self.masses.iter().map(|m| m.kg).sum::<f64>() / self.attachment_points.len().max(1) as f64
        })
    }

    /// The masses, `[masses]`; in a structure of rigid bodies on springs, in the order of the degrees of freedom.
    pub fn masses(&self) -> &[Mass] {
        &self.masses
    }

    /// The stiffnesses, `[springs]`: springs, then beam spans.
    pub fn springs(&self) -> &[Spring] {
        &self.springs
    }

    /// The same structure with other stiffnesses, given as (index of the spring, value in the unit of [`Spring::n_per_m`]).
    ///
    /// Only the changed stiffnesses are checked. If a stiffness of zero makes the structure a mechanism, this is detected when
    /// the eigenvalues are computed.
    ///
    /// # Errors
    /// [`Error::Stiffness`] for a stiffness that is negative or not finite.
    pub fn with_stiffness(&self, changes: &[(usize, f64)]) -> Result<Self, Error> {
        self.check_changes(changes)?;
        let mut changed = self.clone();
        for &(index, n_per_m) in changes {
            changed.springs[index].n_per_m = n_per_m;
        }
        Ok(changed)
    }

    /// Checks that new stiffnesses, given as (index of the spring, value), are finite and not negative.
    pub(super) fn check_changes(&self, changes: &[(usize, f64)]) -> Result<(), Error> {
        changes.iter().try_for_each(|(index, n_per_m)| check_stiffness(&self.springs[*index], *n_per_m))
    }
}

fn check_stiffness(spring: &Spring, n_per_m: f64) -> Result<(), Error> {
    let valid = n_per_m.is_finite() && n_per_m >= 0.0;
    valid.then_some(()).ok_or_else(|| Error::Stiffness { name: spring.name.clone(), n_per_m })
}

/// Checks that no name occurs twice.
fn unique<'a>(names: impl Iterator<Item = &'a String>) -> Result<(), Error> {
    let mut seen = BTreeSet::new();
    names.into_iter().find(|name| !seen.insert(*name)).map_or(Ok(()), |name| Err(Error::DuplicateName(name.clone())))
}

/// Index of a mass that `springs` do not connect to the ground, if there is one.
///
/// `masses` is the number of masses, which have the degrees of freedom 0 to `masses` − 1.
///
/// Springs are one-dimensional, so that K is the Laplacian of a weighted graph with a grounded node: it is singular exactly
/// if a part of the graph is not connected to the ground.
pub fn floating_mass<'a>(masses: usize, springs: impl Iterator<Item = &'a Spring>) -> Option<usize> {
    let ground = masses;
    let mut neighbours = vec![Vec::new(); masses + 1];
    let index = |node: Node| match node {
        Node::Ground => ground,
        Node::Dof(index) => index,
    };
    for spring in springs {
        let Form::Spring(from, to) = &spring.form else { continue };
        let (from, to) = (index(*from), index(*to));
        neighbours[from].push(to);
        neighbours[to].push(from);
    }
    let mut reached = vec![false; masses + 1];
    let mut to_visit = vec![ground];
    while let Some(node) = to_visit.pop() {
        if !std::mem::replace(&mut reached[node], true) {
            to_visit.extend(&neighbours[node]);
        }
    }
    reached[..masses].iter().position(|connected| !connected)
}

//! The drawing of a structure: where its bodies, springs and beams are, and the shapes of its modes.
//!
//! Beams are drawn along their axis in metres. Masses and springs have no coordinates in a structure file: each mass stands as many
//! storeys above the ground as springs lead there, those of one storey side by side. A chain from the ground becomes a tower.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use super::definition::{
    MassDefinition, ParameterDefinition, SimulationKind, SpringDefinition, StructureDefinition, Support,
};
use super::shape_comparison::{MeasuredShape, ShapeComparison};
use super::simulate::Simulator;
use crate::measurement::ModalMeasurement;
use crate::physics;
use crate::physics::beam::Span;
use crate::physics::Form;
use crate::plot::structure::{Body, Drawing, Fixed, Link, LinkKind, Place};
use crate::quantity::with_prefix;

/// What is known about the parts, for their colours and outlines.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Marks {
    /// Change of each spring, beam or parameter by its name, per cent. A spring has the change of the parameter that sets it unless it
    /// has its own.
    pub change_percent: BTreeMap<String, f64>,
    /// Springs, beams or parameters with an open alarm.
    pub alarms: Vec<String>,
}

/// Why a structure is not drawn.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// A table of finite-element runs.
    #[error("a table of finite-element runs has no geometry: only masses, springs and beams can be drawn")]
    NoGeometry,
    /// A mode that is not measured.
    #[error("there is no mode {mode}: the measured modes are 1 to {modes}")]
    NoMode {
        /// The mode asked for, counted from 1.
        mode: usize,
        /// Number of measured modes.
        modes: usize,
    },
    /// The modes cannot be computed.
    #[error(transparent)]
    Physics(#[from] physics::Error),
}

/// Change at which the colours are strongest, per cent.
const FULL_PERCENT: f64 = 10.0;

impl Simulator {
    /// Draws the structure with the marks of its parts. With a `mode`, counted from 1, its shape at the parameters `theta` (`[d]`) is
    /// drawn beside the parts: that of masses to the side, that of beams upwards.
    ///
    /// # Errors
    /// [`Error`], see its variants.
    pub fn drawing(&self, marks: &Marks, mode: Option<(usize, &[f64])>) -> Result<Drawing, Error> {
        let definition = self.definition();
        let mut drawing = match definition.simulation {
            SimulationKind::Table => return Err(Error::NoGeometry),
            SimulationKind::SpringMass => spring_mass(definition),
            SimulationKind::Beam => beam(definition),
        };
        drawing.title.clone_from(&definition.id);
        drawing.full_percent = FULL_PERCENT;
        for link in &mut drawing.links {
            self.mark(link, marks);
        }
        if let Some((mode, theta)) = mode {
            let modes = self.modes();
            if mode == 0 || mode > modes {
                return Err(Error::NoMode { mode, modes });
            }
            drawing.shape_label = format!("mode {mode}, {:.4} Hz", self.frequencies_hz(theta)?[mode - 1]);
            self.add_shape(&mut drawing, mode - 1, modes, theta)?;
        }
        Ok(drawing)
    }

    /// As [`Self::drawing`], with the measured shape of the mode (counted from 1) beside that of the simulated mode which it belongs to at
    /// the parameters `theta` (`[d]`). Without a measured shape of the mode, it is the drawing of the simulated mode alone.
    ///
    /// # Errors
    /// [`Error`], see its variants.
    pub fn drawing_beside(
        &self,
        marks: &Marks,
        (mode, theta): (usize, &[f64]),
        measurements: &[ModalMeasurement],
    ) -> Result<Drawing, Error> {
        let comparison = self.compare_shapes(theta, measurements)?;
        let own = |c: ShapeComparison| {
            let measured = c.measured.iter().find(|m| m.mode + 1 == mode)?.clone();
            Some((c, measured))
        };
        let Some((comparison, measured)) = comparison.and_then(own) else {
            return self.drawing(marks, Some((mode, theta)));
        };
        let mut drawing = self.drawing(marks, None)?;
        let index = measured.simulated_mode;
        let count = comparison.simulated.len();
        drawing.shape_label =
            format!("simulated mode {}, {:.4} Hz", index + 1, comparison.simulated[index].frequency_hz);
        drawing.measured_label = format!("measured mode {mode}, MAC {:.3}", measured.mac[index]);
        let whole = self.add_shape(&mut drawing, index, count, theta)?;
        self.add_measured(&mut drawing, &comparison.points, &measured, &whole);
        Ok(drawing)
    }

    /// Adds a measured shape on the scale of the simulated one: φ·(ψᵀφ)/(φᵀφ) with the simulated displacements ψ at the instrumented
    /// points, out of those of all degrees of freedom, `whole`.
    fn add_measured(&self, drawing: &mut Drawing, points: &[String], measured: &MeasuredShape, whole: &[f64]) {
        let simulated: Vec<f64> = self.shape_dofs().iter().map(|dof| whole[*dof]).collect();
        let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
        let scale = product(&simulated, &measured.shape) / product(&measured.shape, &measured.shape);
        let sideways = self.definition().simulation == SimulationKind::SpringMass;
        let place = |(name, component): (&String, &f64)| {
            let body = drawing.bodies.iter().find(|b| b.name == *name)?;
            let moved = scale * component;
            Some((body.at, if sideways { [moved, 0.0] } else { [0.0, moved] }))
        };
        drawing.measured = points.iter().zip(&measured.shape).filter_map(place).collect();
    }

    /// Colours and outlines a link, and writes the stiffness below its name: the parameters that set it, or its value.
    fn mark(&self, link: &mut Link, marks: &Marks) {
        let sets = |p: &&ParameterDefinition| {
            p.sets.iter().any(|s| s.spring.as_ref() == Some(&link.name) || s.beam.as_ref() == Some(&link.name))
        };
        let parameters: Vec<&str> = self.definition().parameters.iter().filter(sets).map(|p| p.name.as_str()).collect();
        // Where a law lies between, the change of the stiffness itself counts, and not that of its parameter.
        let by_law = format!("spring:{}", link.name);
        let names = || [by_law.as_str(), link.name.as_str()].into_iter().chain(parameters.iter().copied());
        let change = names().find_map(|name| marks.change_percent.get(name).copied());
        let alarm = names().any(|name| marks.alarms.iter().any(|alarm| alarm == name));
        if parameters.iter().any(|name| *name != link.name) {
            link.label = format!("parameter {}", parameters.join(", "));
        }
        (link.change_percent, link.alarm) = (change, alarm);
    }

    /// Adds the shape of mode `index` (from 0) of the lowest `count`: of each body, or along the spans. Returns the displacement of each
    /// degree of freedom.
    fn add_shape(&self, drawing: &mut Drawing, index: usize, count: usize, theta: &[f64]) -> Result<Vec<f64>, Error> {
        let structure = self.structure().ok_or(Error::NoGeometry)?;
        let dofs: Vec<usize> = (0..structure.dofs()).collect();
        let effects = (self.targets(), self.sizes());
        let shapes = self.shapes_under(theta, count, (&effects.0, effects.1), &dofs)?.ok_or(Error::NoGeometry)?;
        let shape: Vec<f64> = shapes.column(index).iter().copied().collect();
        let deflection = |dof: Option<usize>| dof.map_or(0.0, |dof| shape[dof]);
        drawing.shape = if self.definition().simulation == SimulationKind::Beam {
            let bending = structure.springs().iter().filter_map(|s| match &s.form {
                Form::Bending(span) => Some((s.name.as_str(), span)),
                Form::Spring(..) | Form::Inertia(_) | Form::Slope(_) | Form::Spread(..) => None,
            });
            let line = |(name, span): (&str, &Arc<Span>)| {
                let start =
                    drawing.links.iter().find(|l| l.name == name).map_or(0.0, |l| l.ends[0][0].min(l.ends[1][0]));
                let mut x = start;
                let first = span.elements.first().map(|e| ([x, 0.0], [0.0, deflection(e.dofs[0])]));
                let rest = span.elements.iter().map(|e| {
                    x += e.length_m;
                    ([x, 0.0], [0.0, deflection(e.dofs[2])])
                });
                first.into_iter().chain(rest).collect()
            };
            bending.map(line).collect()
        } else {
            let place = |(dof, body): (usize, &Body)| (body.at, [shape[dof], 0.0]);
            let mut bodies: Vec<(Place, Place)> = drawing.bodies.iter().enumerate().map(place).collect();
            // A tower stands on the ground, which does not move.
            if drawing.bodies.windows(2).all(|pair| pair[0].at[1] < pair[1].at[1]) {
                bodies.insert(0, ([drawing.bodies[0].at[0], 0.0], [0.0, 0.0]));
            }
            vec![bodies]
        };
        Ok(shape)
    }
}

/// Masses on springs, each as many storeys above the ground as springs lead there.
fn spring_mass(definition: &StructureDefinition) -> Drawing {
    let masses = &definition.masses;
    let index: BTreeMap<&str, usize> = masses.iter().enumerate().map(|(i, m)| (m.name.as_str(), i)).collect();
    let ends = |s: &SpringDefinition| [index.get(s.from.as_str()).copied(), index.get(s.to.as_str()).copied()];
    let storeys = storeys(masses.len(), &definition.springs.iter().map(ends).collect::<Vec<_>>());
    let mut places: Vec<Place> = Vec::with_capacity(masses.len());
    for (i, storey) in storeys.iter().enumerate() {
        let beside = storeys[..i].iter().filter(|s| *s == storey).count() as f64;
        let all = storeys.iter().filter(|s| *s == storey).count() as f64;
        places.push([1.6 * (beside - 0.5 * (all - 1.0)), *storey as f64]);
    }
    let body = |(mass, at): (&MassDefinition, &Place)| Body {
        name: mass.name.clone(),
        label: with_prefix(mass.kg, "kg"),
        at: *at,
        solid: true,
    };
    let bodies: Vec<Body> = masses.iter().zip(&places).map(body).collect();
    let (mut links, mut fixed) = (Vec::new(), Vec::new());
    let mut grounded = vec![0_usize; masses.len()];
    for (number, spring) in definition.springs.iter().enumerate() {
        let own = ends(spring);
        let link_ends = match own {
            [Some(a), Some(b)] => [places[a], places[b]],
            [Some(a), None] | [None, Some(a)] => {
                let ground = [places[a][0] + 0.5 * grounded[a] as f64, 0.0];
                grounded[a] += 1;
                fixed.push(Fixed::Ground(ground));
                [ground, places[a]]
            }
            [None, None] => continue,
        };
        let before = definition.springs[..number].iter().map(ends);
        let parallel = before.filter(|e| *e == own || (e[1], e[0]) == (own[0], own[1])).count();
        let bend = if own.iter().all(Option::is_some) {
            bend(link_ends, &places, parallel)
        } else {
            ground_bend(link_ends, &places)
        };
        links.push(Link {
            name: spring.name.clone(),
            label: spring.n_per_m.map_or_else(String::new, |k| with_prefix(k, "N/m")),
            kind: LinkKind::Spring,
            ends: link_ends,
            bodies: own,
            bend,
            change_percent: None,
            alarm: false,
        });
    }
    Drawing { bodies, links, fixed, ..Drawing::default() }
}

/// Number of springs from the ground to each of `count` masses on the shortest way, given the masses at the ends of each spring.
fn storeys(count: usize, springs: &[[Option<usize>; 2]]) -> Vec<usize> {
    let mut found: Vec<Option<usize>> = vec![None; count];
    let mut queue = VecDeque::new();
    let on_ground = springs.iter().filter(|ends| ends.contains(&None)).flat_map(|ends| ends.iter().flatten());
    for &mass in on_ground {
        if found[mass].is_none() {
            found[mass] = Some(1);
            queue.push_back(mass);
        }
    }
    while let Some(mass) = queue.pop_front() {
        let storey = found[mass].unwrap_or(1);
        for ends in springs.iter().filter(|ends| ends.contains(&Some(mass))) {
            for &other in ends.iter().flatten() {
                if found[other].is_none() {
                    found[other] = Some(storey + 1);
                    queue.push_back(other);
                }
            }
        }
    }
    found.into_iter().map(|storey| storey.unwrap_or(1)).collect()
}

/// How far a spring goes around the masses between its ends and the springs that join the same two masses.
fn bend([a, b]: [Place; 2], places: &[Place], parallel: usize) -> f64 {
    let passes = places.iter().any(|p| between(*p, a, b));
    let side = if passes { 0.28 } else { 0.0 };
    side + 0.18 * parallel as f64
}

/// A spring to the ground beside a column goes around the masses below it.
fn ground_bend(ends: [Place; 2], places: &[Place]) -> f64 {
    if places.iter().any(|p| between(*p, ends[0], ends[1])) {
        -0.25
    } else {
        0.0
    }
}

/// Whether a place lies on the line between two others.
fn between(p: Place, a: Place, b: Place) -> bool {
    let (along, to) = ([b[0] - a[0], b[1] - a[1]], [p[0] - a[0], p[1] - a[1]]);
    let length2 = along[0].powi(2) + along[1].powi(2);
    let t = (along[0] * to[0] + along[1] * to[1]) / length2.max(1e-12);
    let off = along[0] * to[1] - along[1] * to[0];
    (0.05..=0.95).contains(&t) && off.abs() / length2.sqrt().max(1e-12) < 0.2
}

/// Beams along their axis, with their supports, bodies and springs.
fn beam(definition: &StructureDefinition) -> Drawing {
    let node = |name: &str| definition.nodes.iter().position(|n| n.name == name);
    let at = |index: usize| [definition.nodes[index].x_m, 0.0];
    let mut drawing = Drawing { axis: Some("m".to_owned()), ..Drawing::default() };
    for own in &definition.nodes {
        let masses: Vec<&MassDefinition> =
            definition.masses.iter().filter(|m| m.at.as_deref() == Some(own.name.as_str())).collect();
        let label = masses.iter().map(|m| format!("{} {}", m.name, with_prefix(m.kg, "kg")));
        let label = label.collect::<Vec<_>>().join(", ");
        drawing.bodies.push(Body { name: own.name.clone(), label, at: [own.x_m, 0.0], solid: !masses.is_empty() });
        match own.support {
            Support::Free => {}
            Support::Pinned => drawing.fixed.push(Fixed::Ground([own.x_m, -0.12])),
            Support::Guided => drawing.fixed.push(Fixed::Guide([own.x_m, 0.0])),
            Support::Clamped => drawing.fixed.push(Fixed::Clamp([own.x_m, 0.0])),
        }
    }
    let link = |name: &str, label: String, kind, ends, bodies, bend| Link {
        name: name.to_owned(),
        label,
        kind,
        ends,
        bodies,
        bend,
        change_percent: None,
        alarm: false,
    };
    for beam in &definition.beams {
        if let (Some(a), Some(b)) = (node(&beam.from), node(&beam.to)) {
            let label = beam.bending_stiffness_n_m2.map_or_else(String::new, |k| with_prefix(k, "N·m²"));
            drawing.links.push(link(&beam.name, label, LinkKind::Beam, [at(a), at(b)], [Some(a), Some(b)], 0.0));
        }
    }
    for spring in &definition.springs {
        let bodies = [node(&spring.from), node(&spring.to)];
        let (kind, stiffness, unit) = match spring.n_m_per_rad {
            Some(k) => (LinkKind::Rotation, Some(k), "N·m/rad"),
            None => (LinkKind::Spring, spring.n_per_m, "N/m"),
        };
        let label = stiffness.map_or_else(String::new, |k| with_prefix(k, unit));
        let (ends, bend) = match bodies {
            [Some(a), Some(b)] => ([at(a), at(b)], 0.25),
            [Some(a), None] | [None, Some(a)] if kind == LinkKind::Spring => {
                let ground = [at(a)[0], -1.0];
                drawing.fixed.push(Fixed::Ground(ground));
                ([ground, at(a)], 0.0)
            }
            [Some(a), None] | [None, Some(a)] => ([at(a), at(a)], 0.0),
            [None, None] => continue,
        };
        drawing.links.push(link(&spring.name, label, kind, ends, bodies, bend));
    }
    drawing
}

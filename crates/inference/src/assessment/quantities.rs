//! The monitored quantities of a structure: parameters, spring stiffnesses and groups of parameters.

use super::samples::BatchSamples;
use crate::baseline::Baseline;
use crate::damage::{JointSamples, QuantityKind, QuantitySamples};
use structures::parameter::DamageDirection;

/// Samples of everything that is monitored: each parameter, the stiffness of each spring that a parameter sets through a law, and
/// the mean of each group of parameters that the modes cannot distinguish. The pool has `per_measurement` samples of each
/// measurement.
pub fn monitored_quantities(
    baseline: &Baseline,
    samples: &BatchSamples,
    per_measurement: usize,
) -> Vec<QuantitySamples> {
    let pooled = samples.posterior.first(per_measurement.min(samples.posterior.draws()));
    let prior_bound_mass = samples.posterior.prior_bound_mass(baseline.space());
    let population = |column: usize| &samples.populations.parameters[column];
    let groups = baseline.groups();
    let group_of = |column: usize| groups.iter().find(|g| g.columns.contains(&column)).map(|g| g.name.clone());
    let parameters = baseline.space().iter().enumerate().map(|(column, parameter)| QuantitySamples {
        name: parameter.name.clone(),
        unit: parameter.unit.clone(),
        kind: QuantityKind::Parameter,
        damage: parameter.damage,
        pool: pooled.column(column),
        draws: pooled.draws(),
        population: population(column).clone(),
        prior_bound_mass: prior_bound_mass[column],
        group: group_of(column),
        serial: None,
    });
    let springs = baseline.simulator().derived_stiffnesses().into_iter().map(|spring| {
        let parameter = &baseline.space().as_slice()[spring.parameter];
        let monitored = parameter.damage != DamageDirection::None;
        QuantitySamples {
            pool: pooled.column(spring.parameter).into_iter().map(|p| spring.value(p)).collect(),
            population: population(spring.parameter).through(|p| spring.value(p)),
            unit: "N/m".to_owned(),
            kind: QuantityKind::SpringStiffness,
            damage: if monitored { DamageDirection::Decrease } else { DamageDirection::None },
            draws: pooled.draws(),
            prior_bound_mass: prior_bound_mass[spring.parameter],
            group: group_of(spring.parameter),
            serial: None,
            name: spring.name,
        }
    });
    let of_groups = groups.iter().map(|group| {
        let members: Vec<Vec<f64>> = group.columns.iter().map(|&column| pooled.column(column)).collect();
        let parameter = &baseline.space().as_slice()[group.columns[0]];
        QuantitySamples {
            name: group.name.clone(),
            unit: parameter.unit.clone(),
            kind: QuantityKind::Group,
            damage: parameter.damage,
            pool: (0..members[0].len())
                .map(|i| members.iter().map(|m| m[i]).sum::<f64>() / members.len() as f64)
                .collect(),
            draws: pooled.draws(),
            population: samples.populations.average(&group.columns),
            prior_bound_mass: group.columns.iter().map(|&column| prior_bound_mass[column]).fold(0.0, f64::max),
            group: None,
            serial: None,
        }
    });
    parameters.chain(springs).chain(of_groups).collect()
}

/// Names and correlations of the quantities that take part in the joint probability of damage: parameters with a damage direction,
/// and groups instead of their parameters. A spring that follows a parameter is left out, because it would only repeat that
/// parameter. `None` for fewer than two of them, for more than eight, and where the correlations are not estimated.
pub fn joint_samples(baseline: &Baseline, samples: &BatchSamples) -> Option<JointSamples> {
    let (space, groups) = (baseline.space(), baseline.groups());
    let directed = |column: usize| space.as_slice()[column].damage != DamageDirection::None;
    let is_single = |column: &usize| directed(*column) && !groups.iter().any(|group| group.columns.contains(column));
    let singles: Vec<usize> = (0..space.len()).filter(is_single).collect();
    let of_groups: Vec<_> = groups.iter().filter(|group| directed(group.columns[0])).collect();
    let single_names = singles.iter().map(|&column| space.as_slice()[column].name.clone());
    let names: Vec<String> = single_names.chain(of_groups.iter().map(|group| group.name.clone())).collect();
    let columns = singles.iter().map(|&column| vec![column]);
    let columns: Vec<Vec<usize>> = columns.chain(of_groups.iter().map(|group| group.columns.clone())).collect();
    if names.len() < 2 {
        return None;
    }
    let correlations = samples.populations.correlations_of(&columns)?;
    Some(JointSamples { names, correlations })
}

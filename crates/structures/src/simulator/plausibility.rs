//! Priors that contradict the stated nominal stiffness or mass, such as a factor where a stiffness is expected.

use super::definition::ParameterDefinition;
use super::simulate::Simulator;
use crate::quantity::{significant, with_prefix};

/// Factor by which prior and nominal value differ if a unit or a factor was mistaken.
pub const MISTAKEN: f64 = 10.0;

/// A prior that does not contain the nominal stiffness or mass.
#[derive(Debug, Clone, PartialEq)]
pub struct PriorDoubt {
    /// Whether it is farther from the nominal value than by a factor of [`MISTAKEN`].
    pub far: bool,
    /// The contradiction and its probable cause, in one sentence without a full stop.
    pub message: String,
}

impl Simulator {
    /// The priors that do not contain the stated nominal value of what their parameter sets first. A law, a table, a deviation and a stiffness
    /// that the file does not state give no nominal value to compare with.
    pub fn prior_doubts(&self) -> Vec<PriorDoubt> {
        self.definition().parameters.iter().enumerate().filter_map(|(k, p)| self.prior_doubt(k, p)).collect()
    }

    fn prior_doubt(&self, column: usize, parameter: &ParameterDefinition) -> Option<PriorDoubt> {
        let sets = parameter.sets.first().filter(|sets| sets.law.is_none())?;
        let stated = self.definition().stated_value(sets).filter(|k| *k > 0.0)?;
        let [low, high] = parameter.prior.bounds();
        let nominal = if parameter.scale { 1.0 } else { stated };
        if (low..=high).contains(&nominal) {
            return None;
        }
        let (what, quantity) = (sets.in_words(), if sets.mass.is_some() { "mass" } else { "stiffness" });
        let name = &parameter.name;
        let [from, to] = [low, high].map(significant);
        let message = if parameter.scale {
            let unit = self.definition().unit_of(sets);
            let shown = with_prefix(stated, unit);
            let cause = if (low..=high).contains(&stated) {
                format!("did you mean the {quantity} itself in {unit}? Then remove `scale = true`")
            } else {
                format!("a factor of the nominal {quantity} is mostly between 0.5 and 1.5")
            };
            format!(
                "the prior of {name} runs from {from} to {to} times the nominal {quantity} of {what}, {shown}: {cause}"
            )
        } else {
            let unit = &self.space().as_slice()[column].unit;
            let shown = with_prefix(stated, unit);
            let cause = if looks_like_factor(low, high) {
                format!(
                    "did you mean `scale = true`, with which the prior is a factor of the nominal {quantity}? Without it write prior = {{ uniform \
                     = [{:e}, {:e}] }} for 0.5 to 1.5 times the nominal {quantity}",
                    0.5 * stated,
                    1.5 * stated
                )
            } else {
                "check the units of both".to_owned()
            };
            format!("the prior of {name} runs from {from} to {to} {unit}, but the nominal {quantity} of {what} is {shown}: {cause}")
        };
        let far = nominal > MISTAKEN * high || nominal < low / MISTAKEN;
        Some(PriorDoubt { far, message })
    }

    /// The parameters that are stiffnesses themselves although their prior looks like that of a factor, each as a question.
    pub fn probable_factors(&self) -> Vec<String> {
        let one = |(parameter, unit): (&ParameterDefinition, &String)| {
            let [low, high] = parameter.prior.bounds();
            let itself = !parameter.scale
                && !parameter.sets.is_empty()
                && parameter.sets.iter().all(|s| s.law.is_none() && s.deviation.is_none());
            let stated = parameter.sets.iter().all(|s| self.definition().stated_value(s).is_some());
            let needs = if stated { "" } else { " (it needs the nominal stiffness of what the parameter sets)" };
            (itself && looks_like_factor(low, high)).then(|| {
                format!(
                    "the prior of {} runs from {} to {} {unit}: did you mean `scale = true`{needs}?",
                    parameter.name,
                    significant(low),
                    significant(high)
                )
            })
        };
        let units = self.space().iter().map(|p| &p.unit);
        self.definition().parameters.iter().zip(units).filter_map(one).collect()
    }
}

/// Whether a prior looks like that of a factor: it contains 1 and no value above [`MISTAKEN`].
fn looks_like_factor(low: f64, high: f64) -> bool {
    low <= 1.0 && (1.0..=MISTAKEN).contains(&high)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulator::definition::StructureDefinition;

    fn doubts(prior: &str, further: &str) -> Vec<PriorDoubt> {
        let text = format!(
            r#"
id = "one"
modes = 1
mass = [{{ name = "m1", kg = 1e5 }}]
spring = [{{ name = "k1", from = "ground", to = "m1", n_per_m = 3e7 }}]
parameter = [{{ name = "p", prior = {{ uniform = {prior} }}, sets = {{ spring = "k1" }}{further} }}]
"#
        );
        Simulator::new(StructureDefinition::parse_toml(&text).unwrap()).unwrap().prior_doubts()
    }

    #[test]
    fn a_prior_is_doubted_exactly_if_it_does_not_contain_the_nominal_stiffness() {
        assert_eq!(doubts("[1.5e7, 4.5e7]", ""), []);
        assert_eq!(doubts("[0.5, 1.5]", ", scale = true"), []);
        for (prior, further, far, part) in [
            ("[0.5, 1.5]", "", true, "runs from 0.5 to 1.5 N/m, but the nominal stiffness of spring k1 is 30 MN/m: did you mean `scale = true`"),
            ("[1e7, 2e7]", "", false, "check the units of both"),
            ("[1.5e4, 4.5e4]", "", true, "check the units of both"),
            ("[1.5e7, 4.5e7]", ", scale = true", true, "did you mean the stiffness itself in N/m? Then remove `scale = true`"),
            ("[1.2, 2.0]", ", scale = true", false, "mostly between 0.5 and 1.5"),
        ] {
            let found = doubts(prior, further);
            assert!(found.len() == 1 && found[0].far == far && found[0].message.contains(part), "{prior}: {found:?}");
        }
    }
}

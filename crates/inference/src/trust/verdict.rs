//! The verdict on a batch, which follows from its findings.

use serde::{Deserialize, Serialize};

use super::finding::{Finding, FindingCode, FindingEffect};
use super::fit::Fit;

/// Whether the probability of damage of a batch may be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum TrustVerdict {
    /// No finding rejects the batch.
    Accepted,
    /// A finding rejects the batch: the probability of damage is withheld and no damage alarm is raised.
    Rejected,
}

/// How far an assessment can be trusted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Trust {
    /// The verdict.
    pub verdict: TrustVerdict,
    /// Probability of a misfit at least this large if the simulation is right; `None` where there are no more modes than
    /// parameters, so that nothing can be tested.
    pub p_value: Option<f64>,
    /// Root mean square of the residuals, in standard deviations of the noise and per degree of freedom: about 1 where the
    /// simulation fits.
    pub distance: Option<f64>,
    /// Number of modes minus free parameters, summed over all measurements.
    pub degrees_of_freedom: usize,
    /// Number of independent measurements that those of the batch are worth for the mean, the smallest of all parameters; `None` in
    /// assessments of versions that did not estimate it.
    #[serde(default)]
    pub effective_measurements: Option<f64>,
    /// The findings, those with the strongest effect first.
    pub findings: Vec<Finding>,
}

impl Trust {
    /// The verdict that follows from the findings.
    pub fn new(fit: &Fit, mut findings: Vec<Finding>) -> Self {
        findings.sort_by_key(|finding| std::cmp::Reverse(finding.effect));
        let rejected = findings.iter().any(|f| f.effect == FindingEffect::Reject);
        Self {
            verdict: if rejected { TrustVerdict::Rejected } else { TrustVerdict::Accepted },
            p_value: fit.p_value,
            distance: fit.distance,
            degrees_of_freedom: fit.degrees_of_freedom,
            effective_measurements: None,
            findings,
        }
    }

    /// The trust of an assessment that was stored by a version of the program without this check: accepted, without findings.
    pub fn unknown() -> Self {
        let verdict = TrustVerdict::Accepted;
        let (p_value, distance, effective_measurements) = (None, None, None);
        Self { verdict, p_value, distance, degrees_of_freedom: 0, effective_measurements, findings: Vec::new() }
    }

    /// True unless the batch is rejected.
    pub fn accepted(&self) -> bool {
        self.verdict == TrustVerdict::Accepted
    }

    /// True when the batch may enter the alarm charts.
    pub fn moves_charts(&self) -> bool {
        self.findings.iter().all(|finding| finding.effect == FindingEffect::Note)
    }

    /// True for conditions outside those of the undamaged reference, or parameters where an emulator has no runs.
    pub fn extrapolated(&self) -> bool {
        let beyond = |finding: &Finding| matches!(finding.code, FindingCode::Extrapolated | FindingCode::BeyondRuns);
        self.findings.iter().any(beyond)
    }
}

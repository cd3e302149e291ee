//! **modalwatch** watches structures through their natural frequencies.
//!
//! A batch of measured frequencies goes in; out come the stiffnesses the structure has now, with their spread, and for
//! each the probability that it has fallen below what the undamaged structure showed. Between them stands a conditional
//! invertible neural network, trained once on simulations of the structure.
//!
//! # Crates and modules
//!
//! Data flows in one direction: numbers with units enter at the bottom of this list, and JSON leaves at the top. The science is three
//! crates below this one, `structures`, `inference` and `discrepancy`, whose modules stand here under their own names. Each module
//! uses only modules below it, and no two files of a module use each other in a circle: between crates the compiler ensures this, within a
//! crate `tests/architecture`.
//!
//! ```text
//!  modalwatch: the service, in `src`
//!    cli · http                            commands for people · the HTTP API and the dashboard
//!    config · telemetry                    settings · logs and traces
//!    reproduce                             both cases of the paper by all methods, beside its figures
//!    mqtt                                  batches from a message broker
//!    monitor                               the application: ingest, replay, jobs, upkeep
//!    notify                                webhooks and e-mail
//!    store                                 the database, SQLite or PostgreSQL; the only module with SQL
//!    access                                tokens and scopes
//!    clock · reduction · volume · private  the system clock, data reduction, file systems, permissions
//!  discrepancy, in `crates/discrepancy`: diagnosis: what the simulation gets wrong, and the extension that corrects it
//!  inference, in `crates/inference`
//!    assessment                            from the measurements of a batch to its assessment and its chart points
//!    alarm                                 control charts, their limits, and the states of alarms
//!    damage                                undamaged reference, damage thresholds, probability of damage
//!    process                               how the parameters of a healthy structure move in time, and changes it does not explain
//!    trust                                 whether an answer can be trusted
//!    hierarchy                             the population behind posterior samples
//!    baseline                              trained models: training, calibration, inference, files
//!    posterior                             posterior samples of the parameters, by whichever method
//!    flow                                  the invertible network
//!  structures, in `crates/structures`
//!    updating                              model updating without a network: sensitivity method, TMCMC, laws of springs
//!    simulator                             from parameters to natural frequencies; the structure file
//!    physics | emulator | gsa              eigenproblems | emulators of finite-element runs | Sobol' indices
//!    parameter · measurement               unknowns and their priors · measurements and their checks
//!    quantity · stats · simd · plot        units, statistics, vector arithmetic, SVG
//! ```
//!
//! `docs/architecture.md` follows one batch through these modules.
//!
//! # Reading order
//!
//! [`quantity`], [`parameter`], [`measurement`], then [`physics`] and [`simulator`], then [`flow`] and [`baseline`], then
//! [`damage`], [`monitor`], [`store`], [`http`]; [`discrepancy`] needs only the first five.
//!
//! # Words
//!
//! | word | here |
//! |---|---|
//! | parameter | an unknown of the structure, mostly a stiffness; θ is a vector of them |
//! | batch | measurements of one structure taken in one state |
//! | hyperparameters | mean and standard deviation of a parameter over a batch |
//! | trained model, trained baseline | a trained flow with its manifest: `models/<structure>/baseline.safetensors` and `.json` |
//! | model digest | SHA-256 of the manifest; identifies the trained model in every result |
//! | undamaged reference | the batches that later ones are compared with; declared by `PUT` or `POST …/reference` |
//! | threshold δ | μ_ud − 1.645 σ_ud, the 5 % quantile of the undamaged reference; lower values are considered damaged |
//! | population | normal distribution of a parameter over the measurements of a batch, without their noise |
//! | pool | all posterior samples of a batch together: the paper's estimate, which includes the noise |
//! | probability of damage | P(x < δ) of the population behind a batch; of the pool, its share below δ |
//! | exceedance | a probability of damage above that of the undamaged reference, 5 % |
//! | chart, episode | shift of a batch from the undamaged reference in standard errors; an alarm from its first batch to its end |
//! | effect | target × law × covariate: what acts on a structure beside its parameters |
//! | cause, verdict | an effect that the simulation lacks; the conclusion of a diagnosis about the causes |
//! | extension | a new version of a structure with the causes as effects, and its trained model |
//! | outside | a measurement that no parameters inside the prior can produce |
//!
//! # References
//!
//! - T. Wang et al. (2025), Stochastic model updating and damage detection with a conditional invertible neural network,
//!   Mechanical Systems and Signal Processing 232, 112743. The method.
//! - L. Dinh, J. Sohl-Dickstein, S. Bengio (2017), Density estimation using Real NVP, ICLR. Affine couplings.
//! - L. Ardizzone et al. (2019), Guided image generation with conditional invertible neural networks,
//!   arXiv:1907.02392. Conditions on couplings.
//! - R. B. Nelson (1976), Simplified calculation of eigenvector derivatives, AIAA Journal 14, 1201–1205,
//!   doi:10.2514/3.7211; I. U. Ojalvo (1988), Efficient computation of modal sensitivities for systems with repeated
//!   frequencies, AIAA Journal 26, 361–366, doi:10.2514/3.9897. Derivatives of eigenvalues.
//! - D. W. Hogg, A. D. Myers, J. Bovy (2010), Inferring the eccentricity distribution, The Astrophysical Journal 725,
//!   2166–2175. Populations from posterior samples. A. Gelman (2006), Prior distributions for variance parameters in
//!   hierarchical models, Bayesian Analysis 1, 515–533. The prior of their spread. T. A. Louis (1982), Finding the observed
//!   information matrix when using the EM algorithm, J. R. Stat. Soc. B 44, 226–233. Their importance proposal.
//! - J. Barnard, R. McCulloch, X.-L. Meng (2000), Modeling covariance matrices in terms of standard deviations and correlations,
//!   with application to shrinkage, Statistica Sinica 10, 1281–1311. The prior of correlations. A. Genz (1992), Numerical
//!   computation of multivariate normal probabilities, J. Comput. Graph. Stat. 1, 141–149. The joint probability of damage.
//! - S. Talts et al. (2018), Validating Bayesian inference algorithms with simulation-based calibration,
//!   arXiv:1804.06788; P. Lemos et al. (2023), Sampling-based accuracy testing of posterior estimators for general
//!   inference, ICML. Ranks and TARP.
//! - C. R. Rao (1948), Large sample tests of statistical hypotheses, Proc. Cambridge Phil. Soc. 44, 50–57. Score tests.
//!   R. E. Kass, A. E. Raftery (1995), Bayes factors, JASA 90, 773–795. Laplace's evidence. K. L. Lange, R. J. A. Little,
//!   J. M. G. Taylor (1989), Robust statistical modeling using the t distribution, JASA 84, 881–896.
//! - J. Ching, Y.-C. Chen (2007), Transitional Markov chain Monte Carlo method for Bayesian model updating, Journal of
//!   Engineering Mechanics 133, 816–832. A. Bhattacharyya (1943), On a measure of divergence between two statistical
//!   populations, Bull. Calcutta Math. Soc. 35, 99–109. Stochastic updating.
//! - R. L. Fox, M. P. Kapoor (1968), Rates of change of eigenvalues and eigenvectors, AIAA Journal 6, 2426–2429. Derivatives of
//!   shapes. R. J. Allemang, D. L. Brown (1982), A correlation coefficient for modal vector analysis, IMAC 1, 110–116. MAC.
//! - M. J. W. Jansen (1999), Analysis of variance designs for model output, Computer Physics Communications 117, 35–43;
//!   A. Saltelli et al. (2010), Variance based sensitivity analysis of model output, ibid. 181, 259–270. Sobol' indices.
//! - G. Blatman, B. Sudret (2011), Adaptive sparse polynomial chaos expansion based on least angle regression, Journal of
//!   Computational Physics 230, 2345–2367. Emulators.
//! - R. J. Hyndman, Y. Fan (1996), Sample quantiles in statistical packages, The American Statistician 50, 361–365,
//!   doi:10.1080/00031305.1996.10473566.

#[macro_use]
mod fault;

pub mod access;
pub mod cli;
pub mod clock;
pub mod config;
pub mod http;
pub mod monitor;
pub mod mqtt;
pub mod notify;
pub mod private;
pub mod reduction;
pub mod reproduce;
pub mod store;
pub mod telemetry;
pub mod volume;

pub use discrepancy;
pub use inference::{alarm, assessment, baseline, damage, flow, hierarchy, posterior, process, trust};
pub use structures::{
    emulator, gsa, measurement, parameter, physics, plot, quantity, simd, simulator, stats, updating,
};

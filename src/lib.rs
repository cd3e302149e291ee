//! **modalwatch** watches structures through their natural frequencies.
//!
//! A batch of measured frequencies goes in; out come the stiffnesses the structure has now, with their spread, and for
//! each the probability that it has fallen below what the undamaged structure showed. Between them stands a conditional
//! invertible neural network, trained once on simulations of the structure.
//!
//! # The house
//!
//! Numbers with units enter at the bottom, JSON leaves at the top. Each room uses only rooms below it;
//! `tests/architecture.rs` holds them to it.
//!
//! ```text
//!  cli · http                            the doors      words for people and programs
//!  config · telemetry                    what the doors are set to, and what they log
//!  reproduce                             the exam       the paper's cases by all methods, beside its figures
//!  mqtt                                  the letter box batches from a broker
//!  monitor                               the office     what happens to a batch
//!  notify                                the messenger  who is told of alarms: webhooks
//!  store                                 the archive    the only room that speaks SQL
//!  access                                who may do what: tokens and scopes
//!  assessment                            the result of one batch
//!  alarm                                 charts, limits, states: when to wake somebody
//!  discrepancy                           the study: what the simulation gets wrong, and what would mend it
//!  damage                                judgement on the population behind a batch
//!  trust                                 whether an answer may be believed
//!  hierarchy                             the population behind posterior samples
//!  baseline                              a trained flow, its record, and where it is found
//!  posterior                             samples of the parameters, whoever drew them
//!  updating                              the same question without a flow: sensitivity, TMCMC, laws
//!  simulator                             the bench      parameters in, natural frequencies out
//!  physics | emulator | gsa | flow       workshops      structures | tables of runs | global sensitivity | networks
//!  parameter · measurement               what is unknown · what arrives
//!  quantity · stats · simd · plot · reduction · volume   the foundation
//! ```
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
//! | baseline | a trained flow with its manifest: `models/<structure>/baseline.safetensors` and `.json` |
//! | model digest | SHA-256 of the manifest; names the baseline in every result |
//! | undamaged state | the batches later ones are compared with; made by `POST …/baseline` |
//! | threshold δ | μ_ud − 1.645 σ_ud: below it a value counts as damaged |
//! | population | normal distribution of a parameter over the measurements of a batch, free of their noise |
//! | pool | all posterior samples of a batch together: the paper's estimate, noise included |
//! | probability of damage | P(x < δ) of the population behind a batch; of the pool, its share below δ |
//! | exceedance | a probability of damage above that of the undamaged state, 5 % |
//! | chart, episode | shift of a batch from the undamaged state in standard errors; an alarm from its first batch to its end |
//! | effect | target × law × covariate: what acts on a structure beside its parameters |
//! | cause, verdict | an effect that the simulation lacks; what a diagnosis says of the causes |
//! | extension | a new version of a structure with the causes as effects, and its own baseline |
//! | outside | a measurement that no parameters of the prior give |
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
//!   information matrix when using the EM algorithm, J. R. Stat. Soc. B 44, 226–233. Where their draws are looked for.
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
pub mod alarm;
pub mod assessment;
pub mod baseline;
pub mod cli;
pub mod config;
pub mod damage;
pub mod discrepancy;
pub mod emulator;
pub mod flow;
pub mod gsa;
pub mod hierarchy;
pub mod http;
pub mod measurement;
pub mod monitor;
pub mod mqtt;
pub mod notify;
pub mod parameter;
pub mod physics;
pub mod plot;
pub mod posterior;
pub mod quantity;
pub mod reduction;
pub mod reproduce;
pub mod simd;
pub mod simulator;
pub mod stats;
pub mod store;
pub mod telemetry;
pub mod trust;
pub mod updating;
pub mod volume;

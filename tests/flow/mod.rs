//! Mathematical properties of the flow: inverse, log-determinant, a posterior with a closed form, and its weight files.

mod inherit;

use candle_core::{DType, Device, Tensor};
use modalwatch::flow::pairs::Pairs;
use modalwatch::flow::train::{train, Stopped, TrainSettings};
use modalwatch::flow::weights::{untrained_flow, Weights};
use modalwatch::flow::{checkpoint, Architecture, Flow, FlowSettings};
use modalwatch::stats;
use nalgebra::DMatrix;
use rand::Rng as _;
use rand_distr::StandardNormal;

fn normals(count: usize, seed: u64, purpose: &str) -> Vec<f64> {
    let mut stream = stats::stream(seed, purpose);
    (0..count).map(|_| stream.sample(StandardNormal)).collect()
}

fn tensor(values: &[f64], shape: impl Into<candle_core::Shape>) -> Tensor {
    Tensor::from_slice(values, shape, &Device::Cpu).unwrap()
}

fn small(parameters: usize, modes: usize, seed: u64) -> Architecture {
    let settings = FlowSettings { units: 3, width: 16, context_channels: 4, context_features: 8, clamp_tenths: 30 };
    settings.architecture(parameters, modes, 1, &mut stats::stream(seed, "permutations"))
}

/// A flow far from the identity. The last layers of an untrained flow are zero and are replaced by random weights.
fn random_flow(architecture: &Architecture, seed: u64) -> (Flow, Weights) {
    random_flow_in(DType::F64, architecture, seed)
}

/// The same in single precision, in which a flow is trained and draws.
fn random_flow_in(dtype: DType, architecture: &Architecture, seed: u64) -> (Flow, Weights) {
    let (flow, weights) = untrained_flow(architecture, dtype, seed).unwrap();
    for (name, var) in &weights {
        if name.contains("output") {
            let values: Vec<f64> = normals(var.elem_count(), seed, name).iter().map(|v| 0.1 * v).collect();
            var.set(&tensor(&values, var.shape().clone()).to_dtype(dtype).unwrap()).unwrap();
        }
    }
    (flow, weights)
}

#[test]
fn an_untrained_flow_is_a_permutation_with_log_determinant_zero() {
    let architecture = small(4, 3, 1);
    let (flow, _) = untrained_flow(&architecture, DType::F64, 1).unwrap();
    let x = tensor(&normals(4, 1, "x"), (1, 4));
    let y = tensor(&normals(3, 1, "y"), (1, 1, 3));
    let (z, log_det) = flow.forward(&x, &flow.summarise(&y).unwrap()).unwrap();
    let sorted = |t: &Tensor| {
        let mut values = t.flatten_all().unwrap().to_vec1::<f64>().unwrap();
        values.sort_by(f64::total_cmp);
        values
    };
    assert_eq!(sorted(&x), sorted(&z));
    assert_eq!(log_det.to_vec1::<f64>().unwrap(), [0.0]);
}

#[test]
fn inverse_undoes_forward_for_one_to_six_parameters() {
    for parameters in 1..=6 {
        for seed in 0..5 {
            let (flow, _) = random_flow(&small(parameters, 4, seed), seed);
            let x = tensor(&normals(20 * parameters, seed, "x"), (20, parameters));
            let y = tensor(&normals(20 * 4, seed, "y"), (20, 1, 4));
            let context = flow.summarise(&y).unwrap();
            let (z, log_det) = flow.forward(&x, &context).unwrap();
            let (back, log_det_back) = flow.inverse(&z, &context).unwrap();
            let apart = (log_det - log_det_back).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f64>().unwrap();
            assert!(apart < 1e-10, "{parameters} parameters, seed {seed}: the determinants are {apart} apart");
            let error = (back - &x).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f64>().unwrap();
            let moved = (z - x).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f64>().unwrap();
            assert!(error < 1e-10 && moved > 0.1, "{parameters} parameters, seed {seed}: {error}, moved {moved}");
        }
    }
}

#[test]
fn the_log_determinant_is_that_of_the_finite_difference_jacobian() {
    for parameters in 1..=5 {
        let (flow, _) = random_flow(&small(parameters, 3, 7), 7);
        let point = normals(parameters, 3, "x");
        let context = flow.summarise(&tensor(&normals(3, 3, "y"), (1, 1, 3))).unwrap();
        let z = |x: &[f64]| {
            let (z, _) = flow.forward(&tensor(x, (1, parameters)), &context).unwrap();
            z.flatten_all().unwrap().to_vec1::<f64>().unwrap()
        };
        let h = 1e-6;
        let jacobian = DMatrix::from_fn(parameters, parameters, |row, column| {
            let moved = |sign: f64| {
                let mut x = point.clone();
                x[column] += sign * h;
                z(&x)[row]
            };
            (moved(1.0) - moved(-1.0)) / (2.0 * h)
        });
        let (_, log_det) = flow.forward(&tensor(&point, (1, parameters)), &context).unwrap();
        let error = log_det.to_vec1::<f64>().unwrap()[0] - jacobian.determinant().abs().ln();
        assert!(error.abs() < 1e-8, "{parameters} parameters: {error}");
    }
}

/// Draws by the tiles of `flow::sampler` equal those by candle, for sizes that fill tiles, leave remainders and divide
/// measurements between tiles.
#[test]
fn draws_by_tiles_are_those_of_the_readable_flow() {
    for (parameters, rows, draws) in [(1, 3, 50), (2, 1, 1), (3, 50, 10), (5, 7, 64), (6, 2, 333)] {
        let (flow, _) = random_flow_in(DType::F32, &small(parameters, 4, 3), 3);
        let y = tensor(&normals(4 * rows, 1, "y"), (rows, 1, 4)).to_dtype(DType::F32).unwrap();
        let context = flow.summarise(&y).unwrap();
        let (x, log_q) = flow.sample(&context, draws, &mut stats::stream(9, "latent")).unwrap();
        let z = tensor(&normals(rows * draws * parameters, 9, "latent"), (rows * draws, parameters));
        let width = context.dim(1).unwrap();
        let repeated = context.unsqueeze(1).unwrap().expand((rows, draws, width)).unwrap();
        let repeated = repeated.reshape((rows * draws, width)).unwrap();
        let (expected, _) = flow.inverse(&z.to_dtype(DType::F32).unwrap(), &repeated).unwrap();
        let expected_log_q = flow.log_prob(&expected, &repeated).unwrap();
        let flat = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let pairs =
            flat(&x).into_iter().zip(flat(&expected)).chain(flat(&log_q).into_iter().zip(flat(&expected_log_q)));
        for (found, expected) in pairs {
            assert!((found - expected).abs() < 1e-5 * (1.0 + expected.abs()), "{found}, by candle {expected}");
        }
    }
}

#[test]
fn the_density_integrates_to_one() {
    let (flow, _) = random_flow(&small(2, 3, 5), 5);
    let y = tensor(&normals(3, 5, "y"), (1, 1, 3));
    // The grid covers the range of 20,000 draws, extended by a tenth on each side.
    let (single, _) = random_flow_in(DType::F32, &small(2, 3, 5), 5);
    let context = single.summarise(&y.to_dtype(DType::F32).unwrap()).unwrap();
    let draws = single.sample(&context, 20_000, &mut stats::stream(5, "latent")).unwrap().0;
    let draws = draws.to_dtype(DType::F64).unwrap();
    let side = |column: usize| {
        let values = draws.narrow(1, column, 1).unwrap().flatten_all().unwrap().to_vec1::<f64>().unwrap();
        let (low, high) = values.iter().fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
        (low - 0.1 * (high - low), high + 0.1 * (high - low))
    };
    let points = 501_usize;
    let axis = |column: usize| {
        let (low, high) = side(column);
        let step = (high - low) / (points - 1) as f64;
        ((0..points).map(|i| low + step * i as f64).collect::<Vec<_>>(), step)
    };
    let ((x1, step1), (x2, step2)) = (axis(0), axis(1));
    let grid: Vec<f64> = x1.iter().flat_map(|a| x2.iter().flat_map(|b| [*a, *b])).collect();
    let y = y.expand((points * points, 1, 3)).unwrap().contiguous().unwrap();
    let log_prob = flow.log_prob(&tensor(&grid, (points * points, 2)), &flow.summarise(&y).unwrap()).unwrap();
    let mass: f64 = log_prob.to_vec1::<f64>().unwrap().iter().map(|l| l.exp() * step1 * step2).sum();
    // About 1/20,000 of the mass lies beyond the outermost draw on each of four sides.
    assert!((mass - 1.0).abs() < 5e-4, "{mass}");
}

#[test]
fn the_condition_changes_the_draws_and_the_seed_repeats_them() {
    let (flow, _) = random_flow_in(DType::F32, &small(3, 3, 2), 2);
    let draw = |y: &[f64], seed| {
        let context = flow.summarise(&tensor(y, (1, 1, 3)).to_dtype(DType::F32).unwrap()).unwrap();
        let (x, log_density) = flow.sample(&context, 2, &mut stats::stream(seed, "latent")).unwrap();
        let both = context.expand((2, context.dim(1).unwrap())).unwrap().contiguous().unwrap();
        let again = flow.log_prob(&x, &both).unwrap().to_vec1::<f32>().unwrap();
        for (a, b) in log_density.to_vec1::<f32>().unwrap().iter().zip(again) {
            // Single precision, as in the comparison with candle above.
            assert!((a - b).abs() < 1e-5 * (1.0 + a.abs()), "the density of a draw is {a} and {b}");
        }
        x.flatten_all().unwrap().to_vec1::<f32>().unwrap()
    };
    assert_eq!(draw(&[0.1, 0.2, 0.3], 1), draw(&[0.1, 0.2, 0.3], 1));
    assert_ne!(draw(&[0.1, 0.2, 0.3], 1), draw(&[0.1, 0.2, 0.3], 2));
    assert_ne!(draw(&[0.1, 0.2, 0.3], 1), draw(&[0.1, 0.2, 0.9], 1));
}

/// x ~ N(0, I) in two dimensions, y = A x + 0.5 ε in three: the posterior is normal with known mean and covariance.
struct LinearGaussian {
    a: DMatrix<f64>,
    noise: f64,
}

impl LinearGaussian {
    fn pairs(&self, count: usize, seed: u64) -> Pairs {
        let (x, noise) = (normals(2 * count, seed, "x"), normals(3 * count, seed, "noise"));
        let y = |row: usize, i: usize| {
            self.a[(i, 0)] * x[2 * row] + self.a[(i, 1)] * x[2 * row + 1] + self.noise * noise[3 * row + i]
        };
        let y: Vec<f64> = (0..count).flat_map(|row| [y(row, 0), y(row, 1), y(row, 2)]).collect();
        let as_f32 = |t: Tensor| t.to_dtype(DType::F32).unwrap();
        Pairs { x: as_f32(tensor(&x, (count, 2))), y: as_f32(tensor(&y, (count, 1, 3))) }
    }

    /// Posterior covariance (I + AᵀA/σ²)⁻¹ and mean (covariance · Aᵀ y/σ²).
    fn posterior(&self, y: &[f64]) -> (DMatrix<f64>, DMatrix<f64>) {
        let precision = DMatrix::identity(2, 2) + self.a.transpose() * &self.a / self.noise.powi(2);
        let covariance = precision.try_inverse().unwrap();
        let mean = &covariance * self.a.transpose() * DMatrix::from_column_slice(3, 1, y) / self.noise.powi(2);
        (mean, covariance)
    }
}

#[test]
fn a_trained_flow_finds_the_posterior_of_a_linear_gaussian_model() {
    let model = LinearGaussian { a: DMatrix::from_row_slice(3, 2, &[1.0, 0.3, -0.4, 0.8, 0.5, 0.5]), noise: 0.5 };
    let architecture = small(2, 3, 1);
    let (flow, weights) = untrained_flow(&architecture, DType::F32, 1).unwrap();
    let settings = TrainSettings { epochs: 20, ..TrainSettings::default() };
    let (training, validation) = (model.pairs(10_000, 1), model.pairs(1_000, 2));
    let epoch = |_| Ok(Pairs { x: training.x.clone(), y: training.y.clone() });
    let outcome = train(&flow, &weights, 10_000, epoch, &validation, &settings, |_| {}).unwrap();
    assert!(outcome.best_epoch > 5, "{outcome:?}");

    for y in [[0.0, 0.0, 0.0], [1.0, -0.5, 0.7], [-0.8, 0.9, 0.2]] {
        let (mean, covariance) = model.posterior(&y);
        let condition = tensor(&y, (1, 1, 3)).to_dtype(DType::F32).unwrap();
        let draws = 4_000;
        let context = flow.summarise(&condition).unwrap();
        let samples = flow.sample(&context, draws, &mut stats::stream(3, "latent")).unwrap().0;
        let samples = samples.to_dtype(DType::F64).unwrap().to_vec2::<f64>().unwrap();
        for k in 0..2 {
            let values: Vec<f64> = samples.iter().map(|row| row[k]).collect();
            let exact_std = covariance[(k, k)].sqrt();
            let off = (stats::mean(&values) - mean[(k, 0)]) / exact_std;
            let ratio = stats::sample_std(&values).unwrap() / exact_std;
            // The Monte Carlo error is 0.016 standard deviations and 1.1 %; training on 10,000 pairs leaves errors of
            // about 5 %.
            assert!(off.abs() < 0.15 && (ratio - 1.0).abs() < 0.1, "{y:?}, x{k}: mean off by {off} std, std {ratio}");
        }
    }
}

#[test]
fn training_repeats_bit_for_bit_with_its_seed() {
    let model = LinearGaussian { a: DMatrix::from_row_slice(3, 2, &[1.0, 0.3, -0.4, 0.8, 0.5, 0.5]), noise: 0.5 };
    let bytes = |seed| {
        let (flow, weights) = untrained_flow(&small(2, 3, seed), DType::F32, seed).unwrap();
        let settings = TrainSettings { epochs: 2, seed, ..TrainSettings::default() };
        train(&flow, &weights, 1_000, |_| Ok(model.pairs(1_000, 1)), &model.pairs(100, 2), &settings, |_| {}).unwrap();
        checkpoint::to_bytes(&weights).unwrap()
    };
    assert_eq!(bytes(1), bytes(1));
    assert_ne!(bytes(1), bytes(2));
}

#[test]
fn a_training_that_diverges_stops_and_keeps_the_best_weights() {
    let model = LinearGaussian { a: DMatrix::from_row_slice(3, 2, &[1.0, 0.3, -0.4, 0.8, 0.5, 0.5]), noise: 0.5 };
    let (training, validation) = (model.pairs(600, 1), model.pairs(100, 2));
    let (flow, weights) = untrained_flow(&small(2, 3, 1), DType::F32, 1).unwrap();
    let settings = TrainSettings { epochs: 9, ..TrainSettings::default() };
    let mut validation_losses = Vec::new();
    let epoch = |epoch: usize| {
        // The values that an overflow would give.
        let factor = if epoch < 5 { 1.0 } else { f64::NAN };
        Ok(Pairs { x: (&training.x * factor)?, y: training.y.clone() })
    };
    let outcome = train(&flow, &weights, training.x.dim(0).unwrap(), epoch, &validation, &settings, |report| {
        validation_losses.push(report.validation_loss);
    });
    let outcome = outcome.unwrap();
    assert_eq!(outcome.stopped, Stopped::Diverged { epoch: 5 });
    // The step with a loss that is not finite has changed nothing.
    assert!(outcome.best_epoch <= 4 && validation_losses.len() == 4, "{outcome:?}");
    let context = flow.summarise(&validation.y).unwrap();
    let x = flow.sample(&context, 1, &mut stats::stream(1, "z")).unwrap().0.to_vec2::<f32>().unwrap();
    assert!(x.iter().flatten().all(|v| v.is_finite()));
}

#[test]
fn a_training_that_diverges_at_once_is_an_error() {
    let model = LinearGaussian { a: DMatrix::from_row_slice(3, 2, &[1.0, 0.3, -0.4, 0.8, 0.5, 0.5]), noise: 0.5 };
    let mut poisoned = model.pairs(600, 1);
    let mut x = poisoned.x.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    x[7] = f32::NAN;
    poisoned.x = Tensor::from_vec(x, (600, 2), &Device::Cpu).unwrap();
    let (flow, weights) = untrained_flow(&small(2, 3, 1), DType::F32, 1).unwrap();
    let (rows, validation) = (poisoned.x.dim(0).unwrap(), model.pairs(100, 2));
    let epoch = |_| Ok(Pairs { x: poisoned.x.clone(), y: poisoned.y.clone() });
    let error = train(&flow, &weights, rows, epoch, &validation, &TrainSettings::default(), |_| {}).unwrap_err();
    assert!(error.to_string().contains("not finite in the first epoch"), "{error}");
}

#[test]
fn a_checkpoint_restores_the_same_flow_and_invalid_bytes_are_refused() {
    let architecture = small(3, 4, 1);
    let (flow, weights) = untrained_flow(&architecture, DType::F32, 1).unwrap();
    let bytes = checkpoint::to_bytes(&weights).unwrap();
    let y = tensor(&normals(4, 1, "y"), (1, 1, 4)).to_dtype(DType::F32).unwrap();
    let draws = |flow: &Flow| {
        let context = flow.summarise(&y).unwrap();
        flow.sample(&context, 5, &mut stats::stream(1, "z")).unwrap().0.to_vec2::<f32>().unwrap()
    };
    let loaded = checkpoint::from_bytes(&bytes, &architecture, DType::F32).unwrap();
    assert_eq!(draws(&flow), draws(&loaded));

    let refusal = |bytes: &[u8], architecture: &Architecture| {
        checkpoint::from_bytes(bytes, architecture, DType::F32).err().expect("it should be refused").to_string()
    };
    assert!(refusal(&bytes[..bytes.len() / 2], &architecture).contains("safetensors"));
    assert!(refusal(b"PK\x03\x04 a zip file", &architecture).contains("safetensors"));
    assert!(refusal(&u64::MAX.to_le_bytes(), &architecture).contains("safetensors"));
    assert!(refusal(&bytes, &small(4, 4, 1)).contains("do not fit"));
    assert!(refusal(&bytes, &Architecture { units: 2, permutations: vec![vec![0, 1, 2]; 2], ..architecture.clone() })
        .contains("does not belong"));
    let mut poisoned = bytes.clone();
    let last = poisoned.len() - 4;
    poisoned[last..].copy_from_slice(&f32::NAN.to_le_bytes());
    assert!(refusal(&poisoned, &architecture).contains("not finite"));
}

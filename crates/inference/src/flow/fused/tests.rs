//! Fused training against candle in double precision.

use candle_core::{DType, Device, Tensor};
use rand::Rng as _;
use rand_distr::StandardNormal;

use super::*;
use crate::flow::architecture::FlowSettings;
use crate::flow::pairs::mean_loss;
use crate::flow::weights::untrained_flow;
use structures::stats;

/// Flows in single and double precision with the same weights, none of which is zero, and pairs.
struct Case {
    single: (Flow, Weights),
    double: (Flow, Weights),
    pairs: [Pairs; 2],
}

fn case(parameters: usize, modes: usize, channels: usize, rows: usize) -> Case {
    let settings = FlowSettings { units: 3, width: 24, context_channels: 4, context_features: 8, clamp_tenths: 20 };
    let mut architecture = settings.architecture(parameters, modes, channels, &mut stats::stream(1, "permutations"));
    // `channels` = 0: no context network.
    if channels == 0 {
        architecture.fixed_context = modes;
    }
    let single = untrained_flow(&architecture, DType::F32, 1).unwrap();
    let double = untrained_flow(&architecture, DType::F64, 1).unwrap();
    let mut stream = stats::stream(2, "case");
    for (name, var) in &single.1 {
        // The last layers are initialised to zero, where half of the gradients vanish. With a standard deviation of 0.2 a
        // layer of width 24 approximately preserves the size of its input, so that rounding errors are not amplified.
        let draws: Vec<f32> = (0..var.elem_count()).map(|_| 0.2 * stream.sample::<f32, _>(StandardNormal)).collect();
        var.set(&Tensor::from_vec(draws, var.shape().clone(), &Device::Cpu).unwrap()).unwrap();
        double.1[name].set(&var.to_dtype(DType::F64).unwrap()).unwrap();
    }
    let mut normal = |shape: Vec<usize>| {
        let draws: Vec<f32> = (0..shape.iter().product()).map(|_| stream.sample(StandardNormal)).collect();
        Tensor::from_vec(draws, shape, &Device::Cpu).unwrap()
    };
    let (x, y) = (
        normal(vec![rows, parameters]),
        normal(if channels == 0 { vec![rows, modes] } else { vec![rows, channels, modes] }),
    );
    let pairs =
        [DType::F32, DType::F64].map(|dtype| Pairs { x: x.to_dtype(dtype).unwrap(), y: y.to_dtype(dtype).unwrap() });
    Case { single, double, pairs }
}

#[test]
fn loss_and_gradient_are_those_of_candle() {
    // One parameter (an empty half), odd and even numbers, several channels, no context network, batches smaller than a
    // tile and of many tiles.
    for (parameters, modes, channels, rows) in
        [(1, 2, 1, 7), (3, 3, 1, 64), (4, 5, 3, 150), (5, 1, 2, 700), (6, 9, 0, 65)]
    {
        let case = case(parameters, modes, channels, rows);
        let [single, double] = &case.pairs;
        let mut fused = Fused::new(&case.single.0, &case.single.1).unwrap();
        let data = fused.rows(&case.single.0, single).unwrap();
        let chosen: Vec<u32> = (0..rows as u32).collect();
        let loss = fused.pass(&data, &chosen, true);

        let flow = &case.double.0;
        let expected = mean_loss(flow, &double.x, &double.y).unwrap();
        let gradients = expected.backward().unwrap();
        let expected: f64 = expected.to_scalar().unwrap();
        assert!(
            (loss - expected).abs() < 1e-5 * expected.abs(),
            "{parameters} parameters: loss {loss}, expected {expected}"
        );
        for (name, var) in &case.double.1 {
            let exact = gradients.get(var).unwrap().flatten_all().unwrap().to_vec1::<f64>().unwrap();
            let dense = fused.layout.dense(name.rsplit_once('.').unwrap().0);
            let range = if name.ends_with("weight") { dense.weight } else { dense.bias };
            let found: Vec<f64> = range
                .map(|at| fused.lanes[..lanes(rows)].iter().map(|lane| f64::from(lane.gradient[at])).sum())
                .collect();
            let largest = exact.iter().fold(0.0_f64, |largest, value| largest.max(value.abs()));
            assert!(largest > 0.0, "{name} has no gradient to compare");
            for (found, exact) in found.iter().zip(&exact) {
                assert!((found - exact).abs() < 1e-5 * largest, "{name}: {found}, expected {exact} (of {largest})");
            }
        }
    }
}

#[test]
fn the_optimiser_takes_the_same_steps_as_candle() {
    use candle_nn::{AdamW as Reference, Optimizer as _, ParamsAdamW};
    let case = case(3, 3, 1, 96);
    let [single, double] = &case.pairs;
    let mut fused = Fused::new(&case.single.0, &case.single.1).unwrap();
    let data = fused.rows(&case.single.0, single).unwrap();
    let params = ParamsAdamW { lr: 1e-3, weight_decay: 0.0, ..ParamsAdamW::default() };
    let mut reference = Reference::new(case.double.1.values().cloned().collect(), params).unwrap();
    let chosen: Vec<u32> = (0..96).collect();
    let flow = &case.double.0;
    for step in 0..20 {
        let found = fused.step(&data, &chosen, 1e-3);
        let loss = mean_loss(flow, &double.x, &double.y).unwrap();
        reference.backward_step(&loss).unwrap();
        let expected: f64 = loss.to_scalar().unwrap();
        // The first step is η·g/|g|: for a nearly zero gradient its sign is arbitrary, with hardly any effect on the loss.
        assert!((found - expected).abs() < 1e-4 * expected.abs(), "step {step}: loss {found}, expected {expected}");
    }
}

#[test]
fn the_result_does_not_depend_on_the_number_of_threads() {
    let trained = |threads: usize| {
        let case = case(4, 3, 1, 300);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let mut fused = Fused::new(&case.single.0, &case.single.1).unwrap();
        let data = fused.rows(&case.single.0, &case.pairs[0]).unwrap();
        let chosen: Vec<u32> = (0..300).rev().collect();
        pool.install(|| {
            for _ in 0..5 {
                fused.step(&data, &chosen, 1e-2);
            }
        });
        fused.weights().iter().map(|weight| weight.to_bits()).collect::<Vec<u32>>()
    };
    assert_eq!(trained(1), trained(3));
}

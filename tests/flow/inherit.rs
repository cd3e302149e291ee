//! A flow that takes over the weights of another one and has further inputs.

use candle_core::{DType, Tensor};
use modalwatch::flow::inherit::inherited_flow;
use modalwatch::flow::{checkpoint, Architecture, Flow};

use crate::flow::{normals, random_flow, small, tensor};

const ROWS: usize = 40;

/// Log-densities of `ROWS` rows of x given y, `[n, …]`.
fn log_densities(flow: &Flow, x: &Tensor, y: &Tensor) -> Vec<f64> {
    flow.log_prob(x, &flow.summarise(y).unwrap()).unwrap().to_vec1().unwrap()
}

/// Observations with the inputs of the parent in the order of `inputs`, and other numbers for the new ones. `y`: `[n, inputs,
/// modes]`, or `[n, inputs]`.
fn with_new_inputs(y: &Tensor, inputs: &[Option<usize>], seed: u64) -> Tensor {
    let column = |(index, input): (usize, &Option<usize>)| {
        if let Some(from) = input {
            return y.narrow(1, *from, 1).unwrap();
        }
        let mut shape = y.dims().to_vec();
        shape[1] = 1;
        let count = shape.iter().product();
        tensor(&normals(count, seed, &format!("new input {index}")), shape)
    };
    Tensor::cat(&inputs.iter().enumerate().map(column).collect::<Vec<_>>(), 1).unwrap()
}

#[test]
fn an_untrained_extension_has_the_density_of_its_parent_whatever_the_new_inputs_are() {
    // New inputs at the end, in between and at the beginning; inputs of the parent in another order; one parameter.
    let cases: [(usize, usize, &[Option<usize>]); 4] = [
        (3, 1, &[Some(0), None]),
        (4, 3, &[Some(0), Some(1), Some(2), None, None]),
        (1, 2, &[None, Some(1), None, Some(0)]),
        (5, 2, &[Some(0), Some(1)]),
    ];
    for (parameters, channels, inputs) in cases {
        let modes = 4;
        for fixed in [false, true] {
            let mut of_parent = Architecture { channels, ..small(parameters, modes, 6) };
            let mut architecture = Architecture { channels: inputs.len(), ..of_parent.clone() };
            if fixed {
                (of_parent.fixed_context, architecture.fixed_context) = (channels, inputs.len());
            }
            let (parent, _) = random_flow(&of_parent, 6);
            let (flow, weights) = inherited_flow(&parent, &architecture, inputs).unwrap();
            let x = tensor(&normals(ROWS * parameters, 6, "x"), (ROWS, parameters));
            let shape = if fixed { vec![ROWS, channels] } else { vec![ROWS, channels, modes] };
            let y = tensor(&normals(shape.iter().product(), 6, "y"), shape);
            let expected = log_densities(&parent, &x, &y);
            for seed in [1, 2] {
                let found = log_densities(&flow, &x, &with_new_inputs(&y, inputs, seed));
                for (found, expected) in found.iter().zip(&expected) {
                    assert!((found - expected).abs() < 1e-12 * (1.0 + expected.abs()), "{found}, parent {expected}");
                }
            }
            // After the weights of the new inputs have changed, the density depends on them.
            for var in weights.values() {
                var.set(&(var.as_tensor() + 0.05).unwrap()).unwrap();
            }
            let [one, two] = [1, 2].map(|seed| log_densities(&flow, &x, &with_new_inputs(&y, inputs, seed)));
            assert_eq!(one == two, inputs.iter().all(Option::is_some), "{inputs:?}");
        }
    }
}

#[test]
fn the_weights_of_an_extension_are_a_file_of_its_own_architecture() {
    let of_parent = small(3, 4, 8);
    let architecture = Architecture { channels: 2, ..of_parent.clone() };
    let (parent, _) = random_flow(&of_parent, 8);
    let (flow, weights) = inherited_flow(&parent, &architecture, &[Some(0), None]).unwrap();
    let read = checkpoint::from_bytes(&checkpoint::to_bytes(&weights).unwrap(), &architecture, DType::F64).unwrap();
    let x = tensor(&normals(3 * ROWS, 8, "x"), (ROWS, 3));
    let y = tensor(&normals(8 * ROWS, 8, "y"), (ROWS, 2, 4));
    for (found, expected) in log_densities(&read, &x, &y).iter().zip(log_densities(&flow, &x, &y)) {
        // The file holds single precision.
        assert!((found - expected).abs() < 1e-4 * (1.0 + expected.abs()), "{found}, expected {expected}");
    }
}

#[test]
fn a_parent_of_other_sizes_is_refused() {
    let of_parent = small(3, 4, 9);
    let (parent, _) = random_flow(&of_parent, 9);
    let refused = |architecture: &Architecture, inputs: &[Option<usize>]| {
        inherited_flow(&parent, architecture, inputs).err().expect("another architecture was accepted").to_string()
    };
    let wider = Architecture { width: of_parent.width + 1, ..of_parent.clone() };
    assert!(refused(&wider, &[Some(0)]).contains("more than their inputs"));
    let direct = Architecture { fixed_context: 1, ..of_parent.clone() };
    assert!(refused(&direct, &[Some(0)]).contains("more than their inputs"));
    let two = Architecture { channels: 2, ..of_parent };
    assert!(refused(&two, &[Some(0)]).contains("1 inputs are described"));
    assert!(refused(&two, &[None, None]).contains("taken over once"));
    assert!(refused(&two, &[Some(0), Some(0)]).contains("taken over once"));
}

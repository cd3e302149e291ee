//! Euler–Bernoulli beams made of finite elements with cubic shape functions.
//!
//! Each node of a beam has two degrees of freedom: its deflection w (m) and its rotation w' (rad). A support can fix either.
//! The deflection within an element is the cubic polynomial given by the four degrees of freedom at its ends, and the mass
//! matrix is the consistent one, so that frequencies converge from above with the fourth power of the element length.

/// A finite element between two nodes.
#[derive(Debug, Clone, PartialEq)]
pub struct Element {
    /// Degrees of freedom w_1, w'_1, w_2, w'_2; `None` where a support fixes them.
    pub dofs: [Option<usize>; 4],
    /// Length, m.
    pub length_m: f64,
    /// Factor on its stiffness or mass.
    pub factor: f64,
}

/// Elements with the same bending stiffness and the same mass per length, times their factors.
#[derive(Debug, Clone, PartialEq)]
pub struct Span {
    /// The elements, from left to right.
    pub elements: Vec<Element>,
    /// Position of its left end along the beam, m.
    pub start_m: f64,
}

impl Span {
    /// Length of the span, m.
    pub fn length_m(&self) -> f64 {
        self.elements.iter().map(|e| e.length_m).sum()
    }

    /// Calls `entry(row, column, value)` with the contributions to the stiffness matrix for EI = 1 N·m².
    ///
    /// ```text
    ///  EI/L³ [ 12  6L  −12  6L;  6L  4L²  −6L  2L²;  −12  −6L  12  −6L;  6L  2L²  −6L  4L² ]
    /// ```
    pub fn bending(&self, mut entry: impl FnMut(usize, usize, f64)) {
        for element in &self.elements {
            let l = element.length_m;
            let scale = element.factor * l.powi(-3);
            let matrix = [
                [12.0, 6.0 * l, -12.0, 6.0 * l],
                [6.0 * l, 4.0 * l * l, -6.0 * l, 2.0 * l * l],
                [-12.0, -6.0 * l, 12.0, -6.0 * l],
                [6.0 * l, 2.0 * l * l, -6.0 * l, 4.0 * l * l],
            ];
            element.add(&matrix, scale, &mut entry);
        }
    }

    /// Calls `entry(row, column, value)` with the contributions to the mass matrix for a span of 1 kg.
    ///
    /// ```text
    ///  m_e/420 [ 156  22L  54  −13L;  22L  4L²  13L  −3L²;  54  13L  156  −22L;  −13L  −3L²  −22L  4L² ],
    ///  m_e = L / length of the span
    /// ```
    pub fn inertia(&self, mut entry: impl FnMut(usize, usize, f64)) {
        let total = self.length_m();
        for element in &self.elements {
            let l = element.length_m;
            let scale = element.factor * l / total / 420.0;
            let matrix = [
                [156.0, 22.0 * l, 54.0, -13.0 * l],
                [22.0 * l, 4.0 * l * l, 13.0 * l, -3.0 * l * l],
                [54.0, 13.0 * l, 156.0, -22.0 * l],
                [-13.0 * l, -3.0 * l * l, -22.0 * l, 4.0 * l * l],
            ];
            element.add(&matrix, scale, &mut entry);
        }
    }

    /// Calls `entry(row, column, value)` with the integral of the squared slope: the contributions to the stiffness matrix of a tension of
    /// 1 N, and to the mass matrix of a rotary inertia of 1 kg·m.
    ///
    /// ```text
    ///  ∫ w'² dx:    1/(30L) [ 36  3L  −36  3L;  3L  4L²  −3L  −L²;  −36  −3L  36  −3L;  3L  −L²  −3L  4L² ]
    /// ```
    pub fn slope(&self, mut entry: impl FnMut(usize, usize, f64)) {
        for element in &self.elements {
            let l = element.length_m;
            let scale = element.factor / (30.0 * l);
            let matrix = [
                [36.0, 3.0 * l, -36.0, 3.0 * l],
                [3.0 * l, 4.0 * l * l, -3.0 * l, -l * l],
                [-36.0, -3.0 * l, 36.0, -3.0 * l],
                [3.0 * l, -l * l, -3.0 * l, 4.0 * l * l],
            ];
            element.add(&matrix, scale, &mut entry);
        }
    }

    /// The nodes at the ends of its elements: the position of each along the beam, m, and its deflection and rotation, `None` where a support
    /// fixes them.
    pub fn nodes(&self) -> impl Iterator<Item = (f64, [Option<usize>; 2])> + '_ {
        let first = self.elements.first().map(|e| (self.start_m, [e.dofs[0], e.dofs[1]]));
        let end = |at_m: &mut f64, element: &Element| {
            *at_m += element.length_m;
            Some((*at_m, [element.dofs[2], element.dofs[3]]))
        };
        first.into_iter().chain(self.elements.iter().scan(self.start_m, end))
    }

    /// Positions of the middles of the elements along the beam, m.
    pub fn middles_m(&self) -> impl Iterator<Item = f64> + '_ {
        let before = |at_m: &mut f64, element: &Element| {
            *at_m += element.length_m;
            Some(*at_m - 0.5 * element.length_m)
        };
        self.elements.iter().scan(self.start_m, before)
    }

    /// The span with further factors on its elements.
    #[must_use]
    pub fn times(&self, factors: impl IntoIterator<Item = f64>) -> Self {
        let times = |(element, factor): (&Element, f64)| Element { factor: factor * element.factor, ..element.clone() };
        Self { elements: self.elements.iter().zip(factors).map(times).collect(), ..*self }
    }

    /// The ends whose deflections are held by supports: the position of each, m, and its rotation, if it is free as on a hinge.
    pub fn supports(&self) -> impl Iterator<Item = (f64, Option<usize>)> + '_ {
        self.nodes().filter_map(|(at_m, [deflection, rotation])| deflection.is_none().then_some((at_m, rotation)))
    }
}

impl Element {
    /// Passes `scale`·`matrix` on to the degrees of freedom that are not fixed.
    fn add(&self, matrix: &[[f64; 4]; 4], scale: f64, entry: &mut impl FnMut(usize, usize, f64)) {
        for (row, values) in self.dofs.iter().zip(matrix) {
            for (column, value) in self.dofs.iter().zip(values) {
                if let (Some(row), Some(column)) = (row, column) {
                    entry(*row, *column, scale * value);
                }
            }
        }
    }
}

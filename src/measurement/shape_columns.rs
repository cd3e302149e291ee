//! Columns of a table that hold mode shapes: `phi<mode>_<point>` for the component of a mode's shape at an instrumented point.

/// A column of a mode shape.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum ShapeColumn {
    /// Component of the shape of a mode at a point, by their indices.
    At {
        /// The mode, from 0.
        mode: usize,
        /// The point, from 0.
        point: usize,
    },
    /// Component at a point that is not instrumented.
    Elsewhere {
        /// Name of the point.
        point: String,
    },
}

impl ShapeColumn {
    /// The meaning of a column's name in a table of a structure with the instrumented `points`; `None` for another column. The
    /// names of points are case-sensitive.
    pub(super) fn of(name: &str, points: &[String]) -> Option<Self> {
        let lower = name.to_ascii_lowercase();
        let number = lower.strip_prefix("phi").filter(|_| !points.is_empty())?.split('_').next()?;
        let mode = number.parse::<usize>().ok()?.checked_sub(1)?;
        let point = name.get("phi".len() + number.len() + 1..)?;
        Some(match points.iter().position(|known| known == point) {
            Some(point) => Self::At { mode, point },
            None => Self::Elsewhere { point: point.to_owned() },
        })
    }
}

/// The columns that a mode lacks, given which it has for each of the `points`; empty if it has all or none.
pub(super) fn missing_columns(mode: usize, has: impl Fn(usize) -> bool, points: &[String]) -> Vec<String> {
    let missing: Vec<usize> = (0..points.len()).filter(|point| !has(*point)).collect();
    if missing.len() == points.len() {
        return Vec::new();
    }
    missing.iter().map(|point| format!("phi{}_{}", mode + 1, points[*point])).collect()
}

/// The components of the shapes of a row, which are entered one by one.
#[derive(Debug, Default)]
pub(super) struct ShapeCells {
    /// Mode, point and value of each cell that is not empty.
    cells: Vec<(usize, usize, f64)>,
}

impl ShapeCells {
    pub(super) fn enter(&mut self, mode: usize, point: usize, value: f64) {
        self.cells.push((mode, point, value));
    }

    /// The shapes of `modes` modes at `points` points; `None` if there are none.
    ///
    /// # Errors
    /// The mode whose shape has only some of its components.
    pub(super) fn shapes(self, modes: usize, points: usize) -> Result<Option<Vec<Option<Vec<f64>>>>, String> {
        if self.cells.is_empty() {
            return Ok(None);
        }
        let mut shapes = vec![None; modes];
        for (mode, shape) in shapes.iter_mut().enumerate() {
            let own: Vec<_> = self.cells.iter().filter(|cell| cell.0 == mode).collect();
            if own.is_empty() {
                continue;
            }
            if own.len() < points {
                return Err(format!(
                    "the shape of mode {0} has {1} of {points} components: fill all columns phi{0}_…, or leave all of them empty",
                    mode + 1,
                    own.len()
                ));
            }
            let mut components = vec![0.0; points];
            for (_, point, value) in own {
                components[*point] = *value;
            }
            *shape = Some(components);
        }
        Ok(Some(shapes))
    }
}

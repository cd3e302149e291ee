//! A table of shares as coloured cells with their numbers.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use plotters::style::FontFamily;

use super::panel::{named, SMALL, WIDTH};

const LEFT: i32 = 26;
const TOP: i32 = 26;
const CELL_HEIGHT: i32 = 38;

/// Colour of a share of 1, dark enough for white numbers; the colour of smaller shares is more transparent.
const FULL: RGBColor = RGBColor(0, 90, 156);
const RULE: RGBColor = RGBColor(225, 225, 225);

/// Shares from 0 to 1 in the cells of a grid; a larger share has a darker cell.
#[derive(Debug, Clone, Default)]
pub struct Heat {
    /// Description of the figure for screen readers.
    pub title: String,
    /// Names above the columns.
    pub columns: Vec<String>,
    /// Names beside the rows.
    pub rows: Vec<String>,
    /// Shares, `[rows][columns]`; a cell without a share stays empty.
    pub cells: Vec<Vec<Option<f64>>>,
}

impl Heat {
    /// The grid as SVG.
    pub fn svg(&self) -> String {
        let mut svg = String::new();
        self.draw(&mut svg).expect("drawing into memory cannot fail");
        named(&svg, &self.title)
    }

    fn draw(&self, svg: &mut String) -> Result<(), Box<dyn std::error::Error>> {
        let height = TOP + CELL_HEIGHT * self.rows.len() as i32 + 2;
        let root = SVGBackend::with_string(svg, (WIDTH, height as u32)).into_drawing_area();
        let width = (WIDTH as i32 - LEFT - 2) / self.columns.len().max(1) as i32;
        let text = |colour: RGBColor| {
            let font = (FontFamily::SansSerif, SMALL).into_font().color(&colour);
            font.pos(Pos::new(HPos::Center, VPos::Center))
        };
        for (i, name) in self.columns.iter().enumerate() {
            root.draw(&Text::new(name.clone(), (LEFT + width * i as i32 + width / 2, TOP / 2), text(BLACK)))?;
        }
        for (j, (name, cells)) in self.rows.iter().zip(&self.cells).enumerate() {
            let top = TOP + CELL_HEIGHT * j as i32;
            root.draw(&Text::new(name.clone(), (LEFT / 2 - 1, top + CELL_HEIGHT / 2), text(BLACK)))?;
            for (i, cell) in cells.iter().enumerate() {
                let Some(value) = cell.filter(|v| v.is_finite()) else { continue };
                let left = LEFT + width * i as i32;
                let share = value.clamp(0.0, 1.0);
                let frame = [(left, top), (left + width, top + CELL_HEIGHT)];
                root.draw(&Rectangle::new(frame, FULL.mix(share).filled()))?;
                root.draw(&Rectangle::new(frame, RULE))?;
                // Paler cells show the background of the page, so their numbers have its text colour.
                let ink = if share > 0.75 { RGBColor(255, 255, 255) } else { BLACK };
                // Adding 0 turns −0 into 0.
                let number = format!("{:.2}", (value * 100.0).round() / 100.0 + 0.0).replace('-', "−");
                let middle = (left + width / 2, top + CELL_HEIGHT / 2);
                root.draw(&Text::new(number, middle, text(ink)))?;
            }
        }
        root.present()?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_contain_their_numbers() {
        let heat = Heat {
            title: "shares".to_owned(),
            columns: vec!["a".to_owned(), "b".to_owned()],
            rows: vec!["<f1>".to_owned()],
            cells: vec![vec![Some(0.874), None]],
        };
        let svg = heat.svg();
        assert!(svg.contains("0.87") && svg.matches("<rect").count() == 2 && !svg.contains("<f1>"), "{svg}");
        assert!(Heat::default().svg().starts_with("<svg"));
    }
}

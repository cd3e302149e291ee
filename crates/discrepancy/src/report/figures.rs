//! Numbers as the report writes them.

/// Three significant digits.
pub(super) fn digits(value: f64) -> String {
    if !value.is_finite() {
        return "–".to_owned();
    }
    if value == 0.0 {
        return "0".to_owned();
    }
    let size = value.abs().max(1e-4).log10().floor();
    let digits = (2.0 - size).clamp(0.0, 5.0) as usize;
    format!("{value:.digits$}")
}

/// Three significant digits with a sign.
pub(super) fn plus(value: f64) -> String {
    let text = digits(value);
    signed(&if value > 0.0 { format!("+{text}") } else { text })
}

/// The text with true minus signs.
pub(super) fn signed(text: &str) -> String {
    text.replace('-', "−")
}

/// A probability, as HTML.
pub(super) fn probability(p: f64) -> String {
    match p {
        p if p > 0.9995 => "&gt; 0.999".to_owned(),
        p if p < 0.0005 => "&lt; 0.001".to_owned(),
        p => format!("{p:.3}"),
    }
}

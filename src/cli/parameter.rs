//! The population of a parameter, as given on the command line.

/// Reads name, mean and standard deviation of a parameter from `name=mean,std`.
///
/// # Errors
/// A text of another form.
pub fn parameter_moments(text: &str) -> Result<(String, f64, f64), String> {
    let wrong = || format!("{text:?} must have the form name=mean,std");
    let (name, moments) = text.split_once('=').ok_or_else(wrong)?;
    let (mean, std) = moments.split_once(',').ok_or_else(wrong)?;
    let number = |text: &str| text.trim().parse().map_err(|_| wrong());
    Ok((name.trim().to_owned(), number(mean)?, number(std)?))
}

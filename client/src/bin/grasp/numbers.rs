use std::path::Path;
use std::str::FromStr;

/// N comma-separated numbers.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Numbers<const N: usize>(pub [f64; N]);

impl<const N: usize> FromStr for Numbers<N> {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers: Result<Vec<f64>, _> = text.split(',').map(|number| number.trim().parse()).collect();
        let numbers = numbers.ok().and_then(|numbers| numbers.try_into().ok());
        numbers.map(Self).ok_or_else(|| format!("must be {N} numbers separated by commas"))
    }
}

/// Why a text is no list of numbers, if it is one that was mistyped rather than a file.
pub(crate) fn mistyped(text: &str) -> Option<String> {
    if Path::new(text).exists() {
        return None;
    }
    let words: Vec<&str> = text.split([',', ';', ' ']).map(str::trim).filter(|word| !word.is_empty()).collect();
    let wrong: Vec<&str> = words.iter().copied().filter(|word| word.parse::<f64>().is_err()).collect();
    match wrong[..] {
        [] if !words.is_empty() && words.len() < text.split(',').count() => Some("a number is missing".to_owned()),
        [] if !words.is_empty() && words.len() > text.split(',').count() => {
            Some(format!("it has {} that are not separated by commas", counted(words.len(), "number")))
        }
        [] if !words.is_empty() => Some(format!("it has {}", counted(words.len(), "number"))),
        [one] if words.len() > 2 => Some(format!("`{one}` is not a number")),
        _ => None,
    }
}

/// A coordinate to eight decimals: the digits beyond are noise of 32-bit floats.
pub(crate) fn rounded(number: f64) -> f64 {
    (number * 1e8).round() / 1e8
}

/// A count with its noun.
pub(crate) fn counted(count: usize, noun: &str) -> String {
    format!("{count} {noun}{}", if count == 1 { "" } else { "s" })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_count_of_numbers_is_checked() {
        assert_eq!("1, -2,3e-3".parse::<Numbers<3>>().unwrap().0, [1.0, -2.0, 0.003]);
        assert!("1,2".parse::<Numbers<3>>().is_err() && "1,2,x".parse::<Numbers<3>>().is_err());
        let reason = |text| mistyped(text).unwrap_or_default();
        assert_eq!(reason("300,300,160"), "it has 3 numbers");
        assert_eq!(reason("300 300 160 120"), "it has 4 numbers that are not separated by commas");
        assert_eq!(reason("300,,160,120"), "a number is missing");
        assert_eq!(reason("300,3oo,160,120"), "`3oo` is not a number");
        assert_eq!(mistyped("k,1.json"), None);
    }
}

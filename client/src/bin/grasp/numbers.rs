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

/// A coordinate to eight decimals: the digits beyond are noise of 32-bit floats.
pub(crate) fn short(number: f64) -> f64 {
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
    }
}

use std::str::FromStr;

use crate::metadata_error::{MetadataError, PREFIX};
use crate::onnx::{ModelProto, StringStringEntryProto};

/// Platt's scaling of the log-odds of success (Platt, "Probabilistic Outputs for Support Vector Machines", 1999), so
/// that the predicted probability is the success rate of the grasps that a planner executes. A classifier predicts that
/// of all grasps that it was trained on; the best of many predictions is too high.
///
/// Stored in the file as the property `graspd.calibration`, for example `0.6 -0.3`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Calibration {
    /// Factor of the log-odds, above 0: the order of grasps stays the same.
    pub slope: f32,
    /// Added to them.
    pub offset: f32,
}

const KEY: &str = "calibration";

impl Default for Calibration {
    /// The log-odds as they are.
    fn default() -> Self {
        Self { slope: 1.0, offset: 0.0 }
    }
}

impl Calibration {
    /// The calibrated log-odds.
    #[must_use]
    pub fn apply(&self, log_odds: f32) -> f32 {
        self.slope * log_odds + self.offset
    }

    /// The calibration that applies `earlier` and then this one.
    #[must_use]
    pub fn after(&self, earlier: &Calibration) -> Calibration {
        Calibration { slope: self.slope * earlier.slope, offset: self.apply(earlier.offset) }
    }

    /// The calibration of a model; the default if it has none.
    ///
    /// # Errors
    /// [`MetadataError`] if the property is invalid.
    pub fn from_model(model: &ModelProto) -> Result<Self, MetadataError> {
        let property = model.metadata_props.iter().find(|property| property.key().strip_prefix(PREFIX) == Some(KEY));
        property.map_or(Ok(Self::default()), |property| {
            let value = property.value();
            value.parse().map_err(|expected| MetadataError::Property { key: KEY, value: value.to_owned(), expected })
        })
    }

    /// Replaces the calibration of a model.
    pub fn write_to(&self, model: &mut ModelProto) {
        let key = format!("{PREFIX}{KEY}");
        model.metadata_props.retain(|property| property.key() != key);
        let value = Some(format!("{} {}", self.slope, self.offset));
        model.metadata_props.push(StringStringEntryProto { key: Some(key), value });
    }
}

impl FromStr for Calibration {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let numbers: Option<Vec<f32>> = text.split_whitespace().map(|number| number.parse().ok()).collect();
        match numbers.as_deref() {
            Some(&[slope, offset]) if slope.is_finite() && offset.is_finite() && slope > 0.0 => {
                Ok(Self { slope, offset })
            }
            _ => Err("a slope above 0 and an offset"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_calibration_is_stored_in_the_model() {
        let mut model = ModelProto::default();
        assert_eq!(Calibration::from_model(&model), Ok(Calibration::default()));
        let calibration = Calibration { slope: 0.5, offset: -0.25 };
        for _ in 0..2 {
            calibration.write_to(&mut model);
        }
        assert_eq!(model.metadata_props.len(), 1);
        assert_eq!(Calibration::from_model(&model), Ok(calibration));
        model.metadata_props[0].value = Some("-1 0".to_owned());
        let error = Calibration::from_model(&model).unwrap_err().to_string();
        assert_eq!(error, "the model's property `graspd.calibration` is `-1 0`, must be a slope above 0 and an offset");
    }

    #[test]
    fn calibrations_are_composed() {
        let (first, second) = (Calibration { slope: 0.5, offset: 1.0 }, Calibration { slope: 2.0, offset: -3.0 });
        assert_eq!(second.after(&first).apply(4.0), second.apply(first.apply(4.0)));
    }
}

use grasp_perception::Warning;

use crate::pb;
use crate::pb::geometry_warning::Code;

impl From<&Warning> for pb::GeometryWarning {
    fn from(warning: &Warning) -> Self {
        let degrees = |radians: f64| radians.to_degrees();
        let (code, view, figures): (_, _, &[(&str, f64)]) = match *warning {
            Warning::NoTable { area, expected } => {
                (Code::NoTable, None, &[("area_m2", area), ("expected_height_m", expected)])
            }
            Warning::TableTilted { tilt } => (Code::TableTilted, None, &[("tilt_degrees", degrees(tilt))]),
            Warning::TableHeight { height, expected } => {
                (Code::TableHeight, None, &[("height_m", height), ("expected_height_m", expected)])
            }
            Warning::MostlyUnseen { share } => (Code::MostlyUnseen, None, &[("measured_share", share)]),
            Warning::ViewsDisagree { view, share } => {
                (Code::ViewsDisagree, Some(view), &[("contradicted_share", share)])
            }
            Warning::CameraDistance { view, distance } => {
                (Code::CameraDistance, Some(view), &[("distance_m", distance)])
            }
            Warning::CameraAngle { view, angle } => {
                (Code::CameraAngle, Some(view), &[("angle_degrees", degrees(angle))])
            }
            Warning::DepthScale { view } => (Code::DepthScale, Some(view), &[]),
            Warning::DepthsCorrected { view, factor, height, expected } => (
                Code::DepthsCorrected,
                Some(view),
                &[("factor", factor), ("height_m", height), ("expected_height_m", expected)],
            ),
            Warning::ObjectsLeftOut { left_out, objects, .. } => {
                (Code::ObjectsLeftOut, None, &[("left_out", left_out as f64), ("objects", objects as f64)])
            }
        };
        Self {
            code: code.into(),
            message: warning.to_string(),
            figures: figures.iter().map(|&(name, value)| (name.to_owned(), value)).collect(),
            // Fits: there are at most `MAX_VIEWS`.
            view: view.map(|view| view as u32),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_warning_has_its_sentence_and_figures() {
        let warning = pb::GeometryWarning::from(&Warning::TableHeight { height: 0.0712, expected: 0.05 });
        assert_eq!(warning.code(), Code::TableHeight);
        assert!(warning.message.starts_with("the table is at z = 0.071 m in the volume, expected at 0.050 m"));
        assert_eq!((warning.figures["height_m"], warning.view), (0.0712, None));

        let tilted = pb::GeometryWarning::from(&Warning::TableTilted { tilt: std::f64::consts::FRAC_PI_4 });
        assert!(tilted.message.starts_with("the table is tilted by 45.0°"), "{}", tilted.message);
        assert_eq!(tilted.figures["tilt_degrees"], 45.0);

        let view = pb::GeometryWarning::from(&Warning::ViewsDisagree { view: 3, share: 0.25 });
        assert!(view.message.starts_with("views[3] contradicts the views before it: 25 % of"), "{}", view.message);
        assert_eq!(view.view, Some(3));
    }
}

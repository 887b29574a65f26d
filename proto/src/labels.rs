use std::fmt::Display;

use grasp::RequestError;

use crate::{pb, png};

/// The labels of the pixels of an image of `width` × `height`, row by row. Errors name the field in the message.
pub(crate) fn of_image(labels: &pb::Labels, width: usize, height: usize) -> Result<Vec<u16>, RequestError> {
    match labels.r#type() {
        pb::LabelType::Png => {
            png::grey(&labels.data, width, height).map_err(|reason| RequestError::refused("data", reason))
        }
        _ => with_size(labels, width * height, &format_args!("{width} × {height} pixels")),
    }
}

/// The labels of `count` points or pixels. Errors name the field in the message.
pub(crate) fn of_points(labels: &pb::Labels, count: usize) -> Result<Vec<u16>, RequestError> {
    with_size(labels, count, &format_args!("{count} labels"))
}

fn with_size(labels: &pb::Labels, count: usize, named: &dyn Display) -> Result<Vec<u16>, RequestError> {
    let size = match labels.r#type() {
        pb::LabelType::U8 => 1,
        pb::LabelType::U16 => 2,
        pb::LabelType::Png => return Err(RequestError::invalid("type", "LABEL_TYPE_PNG", "which is only for images")),
        pb::LabelType::Unspecified => {
            let needed = "must be LABEL_TYPE_U8 (1), LABEL_TYPE_U16 (2) or LABEL_TYPE_PNG (3)";
            return Err(RequestError::invalid("type", labels.r#type, needed));
        }
    };
    if labels.data.len() != count * size {
        let (got, kind) = (labels.data.len(), labels.r#type().as_str_name());
        let reason = format_args!("{got} bytes; {named} need {} ({kind})", count * size);
        return Err(RequestError::refused("data", reason));
    }
    Ok(match size {
        1 => labels.data.iter().map(|&label| u16::from(label)).collect(),
        _ => labels.data.as_chunks().0.iter().map(|&bytes| u16::from_le_bytes(bytes)).collect(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(data: &[u8], r#type: pb::LabelType) -> pb::Labels {
        pb::Labels { data: data.to_vec().into(), r#type: r#type.into() }
    }

    #[test]
    fn every_type_gives_the_same_labels() {
        let expected = [0, 3, 7, 255, 1, 0];
        assert_eq!(of_image(&labels(&[0, 3, 7, 255, 1, 0], pb::LabelType::U8), 3, 2).unwrap(), expected);
        let wide: Vec<u8> = expected.iter().flat_map(|label: &u16| label.to_le_bytes()).collect();
        assert_eq!(of_points(&labels(&wide, pb::LabelType::U16), 6).unwrap(), expected);
        assert_eq!(of_image(&labels(&png::grey_png(&expected, 3), pb::LabelType::Png), 3, 2).unwrap(), expected);
    }

    #[test]
    fn invalid_labels_are_named() {
        let refused = |labels: &pb::Labels| of_image(labels, 3, 2).unwrap_err().to_string();
        assert_eq!(refused(&labels(&[0; 5], pb::LabelType::U8)), "data: 5 bytes; 3 × 2 pixels need 6 (LABEL_TYPE_U8)");
        assert_eq!(
            refused(&labels(&[0; 6], pb::LabelType::Unspecified)),
            "type is 0, must be LABEL_TYPE_U8 (1), LABEL_TYPE_U16 (2) or LABEL_TYPE_PNG (3)"
        );
        let of_points = of_points(&labels(&[0; 6], pb::LabelType::Png), 6).unwrap_err();
        assert_eq!(of_points.to_string(), "type is LABEL_TYPE_PNG, which is only for images");
        let other_size = labels(&png::grey_png(&[0; 6], 2), pb::LabelType::Png);
        assert_eq!(refused(&other_size), "data: the PNG has 2 × 3 pixels, the camera has 3 × 2");
        // Of 1 bit: values 0 and 1.
        let mut file = Vec::new();
        let mut encoder = ::png::Encoder::new(&mut file, 3, 2);
        encoder.set_color(::png::ColorType::Grayscale);
        encoder.set_depth(::png::BitDepth::One);
        encoder.write_header().unwrap().write_image_data(&[0b1010_0000, 0b0100_0000]).unwrap();
        let reason = "data: the PNG has the type Grayscale of 1 bits, must be grey of 8 or 16 bits";
        assert_eq!(refused(&labels(&file, pb::LabelType::Png)), reason);
    }
}

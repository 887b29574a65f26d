use std::io::Cursor;

use png::{BitDepth, ColorType, Decoder, Limits};

/// Maximum number of pixels of an image that is sent as PNG. A small file can contain a large image.
const MAX_PIXELS: usize = 1 << 24;

/// The 16-bit grey values of a PNG file of `width` × `height` pixels, row by row; the error says what is wrong.
pub(crate) fn deep_grey(file: &[u8], width: usize, height: usize) -> Result<Vec<u16>, String> {
    decoded(file, width, height, &[BitDepth::Sixteen])
}

/// The 8-bit or 16-bit grey values of a PNG file, as [`deep_grey`].
pub(crate) fn grey(file: &[u8], width: usize, height: usize) -> Result<Vec<u16>, String> {
    decoded(file, width, height, &[BitDepth::Eight, BitDepth::Sixteen])
}

fn decoded(file: &[u8], width: usize, height: usize, depths: &[BitDepth]) -> Result<Vec<u16>, String> {
    let pixels = width * height;
    if pixels > MAX_PIXELS {
        return Err(format!("an image of {width} × {height} pixels is too large for PNG, at most {MAX_PIXELS} in all"));
    }
    let decoder = Decoder::new_with_limits(Cursor::new(file), Limits { bytes: 4 * MAX_PIXELS });
    let not_png = |error: png::DecodingError| format!("not a valid PNG file: {error}");
    let mut reader = decoder.read_info().map_err(not_png)?;
    let info = reader.info();
    if (info.width as usize, info.height as usize) != (width, height) {
        let (w, h) = (info.width, info.height);
        return Err(format!("the PNG has {w} × {h} pixels, the camera has {width} × {height}"));
    }
    let (color, depth) = reader.output_color_type();
    if color != ColorType::Grayscale || !depths.contains(&depth) {
        let bits: Vec<String> = depths.iter().map(|depth| (*depth as u8).to_string()).collect();
        let (depth, bits) = (depth as u8, bits.join(" or "));
        return Err(format!("the PNG has the type {color:?} of {depth} bits, must be grey of {bits} bits"));
    }
    let size = depth as usize / 8;
    let mut data = vec![0; pixels * size];
    reader.next_frame(&mut data).map_err(not_png)?;
    Ok(match size {
        1 => data.into_iter().map(u16::from).collect(),
        // PNG is big-endian.
        _ => data.as_chunks().0.iter().map(|&bytes| u16::from_be_bytes(bytes)).collect(),
    })
}

/// A PNG file of 16-bit grey values, row by row, compressed quickly. Values after the last whole row are left out;
/// without a whole row the file is empty, which the server refuses.
#[must_use]
pub fn grey_png(values: &[u16], width: u32) -> Vec<u8> {
    let mut file = Vec::new();
    let rows = values.chunks_exact(width.max(1) as usize);
    let mut encoder = png::Encoder::new(&mut file, width, u32::try_from(rows.len()).unwrap_or(0));
    encoder.set_color(ColorType::Grayscale);
    encoder.set_depth(BitDepth::Sixteen);
    encoder.set_compression(png::Compression::Fast);
    let bytes: Vec<u8> = rows.flatten().flat_map(|value| value.to_be_bytes()).collect();
    match encoder.write_header().and_then(|mut writer| writer.write_image_data(&bytes)) {
        Ok(()) => file,
        Err(_) => Vec::new(),
    }
}

//! An SVG as a PNG. The font is compiled in, so that the same drawing gives the same bytes on every machine.
//!
//! The text shaper takes a tenth of a first build, so it is behind the feature `png`.

use std::sync::Arc;

use resvg::{tiny_skia, usvg};

use crate::drawing::FONT;

/// A PNG cannot be made.
#[derive(Debug, thiserror::Error)]
#[error("the drawing cannot become a PNG: {0}; draw it as SVG instead")]
pub struct PngError(String);

/// A drawing as PNG bytes, `scale` pixels per SVG pixel.
///
/// # Errors
/// When it is no SVG, or the image would have no pixels or too many.
pub fn png(svg: &str, scale: f32) -> Result<Vec<u8>, PngError> {
    let mut fonts = usvg::fontdb::Database::new();
    for font in [dejavu::sans::regular(), dejavu::sans::bold()] {
        fonts.load_font_data(font.to_vec());
    }
    fonts.set_sans_serif_family(FONT);
    let options = usvg::Options { fontdb: Arc::new(fonts), font_family: FONT.to_owned(), ..usvg::Options::default() };
    let tree = usvg::Tree::from_str(svg, &options).map_err(|error| PngError(error.to_string()))?;
    let size = tree.size().to_int_size();
    let pixels = |length: u32| (f64::from(length) * f64::from(scale)).round() as u32;
    let mut image = tiny_skia::Pixmap::new(pixels(size.width()), pixels(size.height()))
        .ok_or_else(|| PngError(format!("no image of scale {scale} can be made")))?;
    resvg::render(&tree, tiny_skia::Transform::from_scale(scale, scale), &mut image.as_mut());
    image.encode_png().map_err(|error| PngError(error.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_has_letters_without_fonts_of_the_machine() {
        let letters = r#"<svg xmlns="http://www.w3.org/2000/svg" width="60" height="30"><text y="20" font-family="DejaVu Sans">room</text></svg>"#;
        let blank = r#"<svg xmlns="http://www.w3.org/2000/svg" width="60" height="30"/>"#;
        assert_eq!(png(letters, 1.0).unwrap()[..4], *b"\x89PNG");
        assert_ne!(png(letters, 1.0).unwrap(), png(blank, 1.0).unwrap());
    }

    #[test]
    fn text_that_is_no_drawing_and_a_scale_of_zero_are_errors() {
        assert!(png("no drawing", 1.0).unwrap_err().to_string().contains("SVG"));
        assert!(png(r#"<svg xmlns="http://www.w3.org/2000/svg" width="60" height="30"/>"#, 0.0).is_err());
    }
}

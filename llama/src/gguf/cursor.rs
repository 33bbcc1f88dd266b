//! A reader of GGUF values with a limit on each.

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

use super::{
    ARRAY_ELEMENTS_MAX, DIMENSIONS_MAX, GgufError, KEPT_BYTES_MAX, STRING_BYTES_MAX, TENSOR_NAME_BYTES_MAX, TYPE_ARRAY,
    TYPE_STRING, Tensor, VOCABULARY_KEY, Value, scalar_type, tensor_type,
};

/// A reader that knows its place in the file, so that every error can name it and each length is checked before it is used.
pub(super) struct Cursor<'a> {
    pub(super) input: BufReader<File>,
    pub(super) path: &'a Path,
    pub(super) position: u64,
    pub(super) size_bytes: u64,
    pub(super) kept_bytes: u64,
}

impl Cursor<'_> {
    pub(super) fn malformed(&self, place: &str, reason: impl Into<String>) -> GgufError {
        GgufError::Malformed { path: self.path.to_owned(), place: place.to_owned(), reason: reason.into() }
    }

    /// Fails if fewer than `bytes` remain. Called before memory of that size is allocated.
    pub(super) fn require(&self, bytes: u64, place: &str) -> Result<(), GgufError> {
        let needed = self.position.saturating_add(bytes);
        if needed > self.size_bytes {
            return Err(GgufError::Truncated {
                path: self.path.to_owned(),
                place: place.to_owned(),
                needed,
                size_bytes: self.size_bytes,
            });
        }
        Ok(())
    }

    pub(super) fn fill(&mut self, buffer: &mut [u8], place: &str) -> Result<(), GgufError> {
        self.require(buffer.len() as u64, place)?;
        self.input.read_exact(buffer).map_err(|source| GgufError::Io { path: self.path.to_owned(), source })?;
        self.position += buffer.len() as u64;
        Ok(())
    }

    pub(super) fn skip(&mut self, bytes: u64, place: &str) -> Result<(), GgufError> {
        self.require(bytes, place)?;
        // A relative seek keeps the buffered bytes.
        let step = i64::try_from(bytes).map_err(|_| self.malformed(place, "its size passes 2^63 bytes"))?;
        self.input.seek_relative(step).map_err(|source| GgufError::Io { path: self.path.to_owned(), source })?;
        self.position += bytes;
        Ok(())
    }

    pub(super) fn bytes<const N: usize>(&mut self, place: &str) -> Result<[u8; N], GgufError> {
        let mut buffer = [0; N];
        self.fill(&mut buffer, place)?;
        Ok(buffer)
    }

    pub(super) fn u32(&mut self, place: &str) -> Result<u32, GgufError> {
        self.bytes(place).map(u32::from_le_bytes)
    }

    pub(super) fn u64(&mut self, place: &str) -> Result<u64, GgufError> {
        self.bytes(place).map(u64::from_le_bytes)
    }

    pub(super) fn string(&mut self, limit_bytes: u64, place: &str) -> Result<Vec<u8>, GgufError> {
        let length = self.u64(place)?;
        if length > limit_bytes {
            return Err(self.malformed(place, format!("a string of {length} bytes, the limit is {limit_bytes}")));
        }
        self.require(length, place)?;
        // Checked against the limit above, which fits any usize.
        let mut buffer = vec![0; length as usize];
        self.fill(&mut buffer, place)?;
        Ok(buffer)
    }

    /// Counts stored bytes, and fails if the sum is too large.
    pub(super) fn keep(&mut self, bytes: usize, place: &str) -> Result<(), GgufError> {
        self.kept_bytes = self.kept_bytes.saturating_add(bytes as u64);
        if self.kept_bytes > KEPT_BYTES_MAX {
            let reason = format!("with it, keys, texts and tokens are more than {KEPT_BYTES_MAX} bytes together");
            return Err(self.malformed(place, reason));
        }
        Ok(())
    }

    /// Reads a text to store. Bytes that are not UTF-8 become longer ones.
    pub(super) fn text(&mut self, place: &str) -> Result<String, GgufError> {
        let text = String::from_utf8_lossy(&self.string(STRING_BYTES_MAX, place)?).into_owned();
        self.keep(text.len(), place)?;
        Ok(text)
    }

    pub(super) fn value(&mut self, key: &str, vocabulary: &mut Vec<Vec<u8>>) -> Result<Value, GgufError> {
        let number = self.u32(key)?;
        Ok(match number {
            0 => Value::Unsigned(u64::from(self.bytes::<1>(key)?[0])),
            1 => Value::Signed(i64::from(i8::from_le_bytes(self.bytes(key)?))),
            2 => Value::Unsigned(u64::from(u16::from_le_bytes(self.bytes(key)?))),
            3 => Value::Signed(i64::from(i16::from_le_bytes(self.bytes(key)?))),
            4 => Value::Unsigned(u64::from(self.u32(key)?)),
            5 => Value::Signed(i64::from(i32::from_le_bytes(self.bytes(key)?))),
            6 => Value::Float(f64::from(f32::from_le_bytes(self.bytes(key)?))),
            7 => Value::Bool(self.bytes::<1>(key)?[0] != 0),
            TYPE_STRING => Value::Text(self.text(key)?),
            TYPE_ARRAY => self.array(key, vocabulary)?,
            10 => Value::Unsigned(self.u64(key)?),
            11 => Value::Signed(i64::from_le_bytes(self.bytes(key)?)),
            12 => Value::Float(f64::from_le_bytes(self.bytes(key)?)),
            _ => return Err(self.malformed(key, format!("unknown value type {number}"))),
        })
    }

    pub(super) fn array(&mut self, key: &str, vocabulary: &mut Vec<Vec<u8>>) -> Result<Value, GgufError> {
        let number = self.u32(key)?;
        let length = self.u64(key)?;
        if length > ARRAY_ELEMENTS_MAX {
            return Err(
                self.malformed(key, format!("an array of {length} elements, the limit is {ARRAY_ELEMENTS_MAX}"))
            );
        }
        if number == TYPE_STRING {
            for _ in 0..length {
                let text = self.string(STRING_BYTES_MAX, key)?;
                if key == VOCABULARY_KEY {
                    self.keep(size_of::<Vec<u8>>() + text.len(), key)?;
                    vocabulary.push(text);
                }
            }
            return Ok(Value::Array { element: "string", length });
        }
        let Some((element, element_bytes)) = scalar_type(number) else {
            return Err(self.malformed(key, format!("an array of the unknown or nested type {number}")));
        };
        self.skip(length * element_bytes, key)?;
        Ok(Value::Array { element, length })
    }

    pub(super) fn tensor(&mut self, index: u64) -> Result<(Tensor, u64), GgufError> {
        let place = format!("tensor {index}");
        let name = String::from_utf8_lossy(&self.string(TENSOR_NAME_BYTES_MAX - 1, &place)?).into_owned();
        let place = format!("tensor {name:?}");
        let dimensions = self.u32(&place)?;
        if dimensions > DIMENSIONS_MAX {
            return Err(self.malformed(&place, format!("{dimensions} dimensions, the limit is {DIMENSIONS_MAX}")));
        }
        let mut shape = Vec::with_capacity(dimensions as usize);
        let mut elements: u64 = 1;
        for _ in 0..dimensions {
            let extent = self.u64(&place)?;
            elements = elements
                .checked_mul(extent)
                .filter(|&elements| elements > 0 && i64::try_from(elements).is_ok())
                .ok_or_else(|| self.malformed(&place, "an empty shape, or one with more than 2^63 elements"))?;
            shape.push(extent);
        }
        let number = self.u32(&place)?;
        let Some((kind, block_elements, block_bytes)) = tensor_type(number) else {
            return Err(self.malformed(&place, format!("unknown tensor type {number}")));
        };
        if shape.first().copied().unwrap_or(1) % block_elements != 0 {
            return Err(
                self.malformed(&place, format!("rows that are no multiple of {kind}'s {block_elements} elements"))
            );
        }
        let size_bytes = (elements / block_elements)
            .checked_mul(block_bytes)
            .ok_or_else(|| self.malformed(&place, "a size of more than 2^64 bytes"))?;
        let offset = self.u64(&place)?;
        Ok((Tensor { name, shape, kind, elements, start: 0, size_bytes }, offset))
    }
}

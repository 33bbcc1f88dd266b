//! Reads and checks the header of a GGUF model file without llama.cpp.
//!
//! llama.cpp trusts a model file further than a service may: some broken vocabularies end the process. So safe code with a limit on
//! everything reads every file first. llama.cpp gets only a file with consistent metadata, vocabulary and tensor extents. The same header
//! feeds `roomcast model info`.
//!
//! Format: GGUF versions 2 and 3, little-endian, as llama.cpp writes them: magic, version, tensor count, metadata count, metadata (key,
//! type, value), tensor descriptions (name, shape, type, offset), padding to the alignment, tensor data.

use std::collections::{BTreeMap, HashSet};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

mod cursor;

use cursor::Cursor;

/// Most metadata entries of a header; known models have fewer than a hundred.
const METADATA_ENTRIES_MAX: u64 = 4_096;
/// Most tensors of a file; models of 400 billion parameters have about two thousand.
const TENSORS_MAX: u64 = 65_536;
/// Most bytes of one key or string of the metadata; chat templates are the longest, with some tens of kilobytes.
const STRING_BYTES_MAX: u64 = 1 << 20;
/// Most elements of one metadata array; the largest vocabularies have about 300 000 tokens.
const ARRAY_ELEMENTS_MAX: u64 = 1 << 22;
/// Most bytes of all keys, texts and tokens together in memory; the largest vocabularies take some 12 MB.
const KEPT_BYTES_MAX: u64 = 64 << 20;
/// Most bytes of one tensor name, with the terminating zero of llama.cpp's buffer.
const TENSOR_NAME_BYTES_MAX: u64 = 64;
/// ggml's limit on the dimensions of a tensor.
const DIMENSIONS_MAX: u32 = 4;
/// Alignment of the tensor data without `general.alignment`.
const ALIGNMENT_BYTES_DEFAULT: u64 = 32;

/// The file is not a usable GGUF model.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum GgufError {
    /// The file cannot be opened or read.
    #[error("failed to read model file {path}: {source}; check the path and its permissions")]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The first four bytes are not `GGUF`.
    #[error(
        "{path} is no GGUF model: it starts with \"{found}\", not with \"GGUF\"; convert it with llama.cpp's convert_hf_to_gguf.py or choose a .gguf file"
    )]
    Magic {
        /// The file.
        path: PathBuf,
        /// Its first four bytes, unprintable ones escaped.
        found: String,
    },
    /// The version is not 2 or 3, or the file is big-endian.
    #[error(
        "{path} has GGUF version {version}, and versions 2 and 3 in little-endian order can be read; convert the model again with a current llama.cpp"
    )]
    Version {
        /// The file.
        path: PathBuf,
        /// The version that the file names.
        version: u32,
    },
    /// The file ends inside the header or before its last tensor.
    #[error(
        "{path} is truncated: {place} needs bytes up to {needed}, and the file has {size_bytes}; copy or download it again"
    )]
    Truncated {
        /// The file.
        path: PathBuf,
        /// The part that was read.
        place: String,
        /// The least size of a complete file, in bytes.
        needed: u64,
        /// The file's size, in bytes.
        size_bytes: u64,
    },
    /// The header contradicts itself or exceeds a limit.
    #[error(
        "{path} is malformed at {place}: {reason}; the file is damaged or was written by a faulty tool, get it again from its source"
    )]
    Malformed {
        /// The file.
        path: PathBuf,
        /// The metadata key or the tensor.
        place: String,
        /// The fault.
        reason: String,
    },
    /// A valid GGUF file without a language model that can score text.
    #[error(
        "{path} holds no language model that Roomcast can run: {reason}; choose a GGUF file of a causal language model with its vocabulary"
    )]
    NotALanguageModel {
        /// The file.
        path: PathBuf,
        /// The missing part.
        reason: String,
    },
    /// The file is one part of a model in several files, and other parts are missing.
    #[error("{path} is part {number} of {count} of a model: {reason}")]
    Parts {
        /// The file.
        path: PathBuf,
        /// The number of the part, from 1.
        number: u64,
        /// The number of parts of the model.
        count: u64,
        /// The fault, and the remedy.
        reason: String,
    },
}

/// A metadata value. Arrays are checked and counted; only arrays that a later check needs are stored.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// An unsigned integer of any size.
    Unsigned(u64),
    /// A signed integer of any size.
    Signed(i64),
    /// f32 or f64.
    Float(f64),
    /// A boolean.
    Bool(bool),
    /// Text; bytes that are not UTF-8 are replaced.
    Text(String),
    /// An array: the name of its element type, and its length.
    Array {
        /// Element type as GGUF names it: `u8`, `i32`, `f32`, `string`, ...
        element: &'static str,
        /// Number of elements.
        length: u64,
    },
}

/// One tensor of the file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tensor {
    /// Name, such as `blk.0.attn_q.weight`.
    pub name: String,
    /// Elements per dimension, fastest first.
    pub shape: Vec<u64>,
    /// Name of the ggml type, such as `Q4_0`.
    pub kind: &'static str,
    /// Number of elements, the product of the shape.
    pub elements: u64,
    /// Start in the file, in bytes.
    pub start: u64,
    /// Size in the file, in bytes.
    pub size_bytes: u64,
}

/// The checked header of a GGUF file.
#[derive(Debug, Clone)]
pub struct Header {
    path: PathBuf,
    /// GGUF version, 2 or 3.
    pub version: u32,
    /// Size of the file, in bytes.
    pub size_bytes: u64,
    /// Metadata by key.
    pub metadata: BTreeMap<String, Value>,
    /// Tensors in the order of the file.
    pub tensors: Vec<Tensor>,
    vocabulary: Vec<Vec<u8>>,
}

/// Name, elements per block and bytes per block of a ggml tensor type; `None` for a number that ggml has retired or not assigned.
fn tensor_type(number: u32) -> Option<(&'static str, u64, u64)> {
    Some(match number {
        0 => ("F32", 1, 4),
        1 => ("F16", 1, 2),
        2 => ("Q4_0", 32, 18),
        3 => ("Q4_1", 32, 20),
        6 => ("Q5_0", 32, 22),
        7 => ("Q5_1", 32, 24),
        8 => ("Q8_0", 32, 34),
        9 => ("Q8_1", 32, 36),
        10 => ("Q2_K", 256, 84),
        11 => ("Q3_K", 256, 110),
        12 => ("Q4_K", 256, 144),
        13 => ("Q5_K", 256, 176),
        14 => ("Q6_K", 256, 210),
        15 => ("Q8_K", 256, 292),
        16 => ("IQ2_XXS", 256, 66),
        17 => ("IQ2_XS", 256, 74),
        18 => ("IQ3_XXS", 256, 98),
        19 => ("IQ1_S", 256, 50),
        20 => ("IQ4_NL", 32, 18),
        21 => ("IQ3_S", 256, 110),
        22 => ("IQ2_S", 256, 82),
        23 => ("IQ4_XS", 256, 136),
        24 => ("I8", 1, 1),
        25 => ("I16", 1, 2),
        26 => ("I32", 1, 4),
        27 => ("I64", 1, 8),
        28 => ("F64", 1, 8),
        29 => ("IQ1_M", 256, 56),
        30 => ("BF16", 1, 2),
        34 => ("TQ1_0", 256, 54),
        35 => ("TQ2_0", 256, 66),
        39 => ("MXFP4", 32, 17),
        40 => ("NVFP4", 64, 36),
        41 => ("Q1_0", 128, 18),
        42 => ("Q2_0", 64, 18),
        _ => return None,
    })
}

/// Name and size in bytes of a metadata type of fixed size; strings are type 8, arrays type 9.
fn scalar_type(number: u32) -> Option<(&'static str, u64)> {
    Some(match number {
        0 => ("u8", 1),
        1 => ("i8", 1),
        2 => ("u16", 2),
        3 => ("i16", 2),
        4 => ("u32", 4),
        5 => ("i32", 4),
        6 => ("f32", 4),
        7 => ("bool", 1),
        10 => ("u64", 8),
        11 => ("i64", 8),
        12 => ("f64", 8),
        _ => return None,
    })
}

const TYPE_STRING: u32 = 8;
const TYPE_ARRAY: u32 = 9;
const VOCABULARY_KEY: &str = "tokenizer.ggml.tokens";
/// Most parts of a model: llama.cpp counts them in 16 bits.
const PARTS_MAX: u64 = 65_535;
const JOIN: &str = "join them with llama.cpp's `llama-gguf-split --merge`";

/// Opens a plain file. Opening a FIFO or a device would wait for its writer.
pub(crate) fn open_plain(path: &Path) -> std::io::Result<File> {
    match std::fs::metadata(path)?.is_file() {
        true => File::open(path),
        false => Err(std::io::Error::other("it is no plain file")),
    }
}

impl Header {
    /// Reads and checks the header of the file at `path`; its tensor data is not read.
    ///
    /// # Errors
    ///
    /// [`GgufError`] for a file that cannot be read, is no GGUF, is truncated anywhere (the tensor data included), passes one of
    /// this module's limits or contradicts itself.
    pub fn read(path: &Path) -> Result<Self, GgufError> {
        let io = |source| GgufError::Io { path: path.to_owned(), source };
        let file = open_plain(path).map_err(io)?;
        let size_bytes = file.metadata().map_err(io)?.len();
        let mut cursor = Cursor { input: BufReader::new(file), path, position: 0, size_bytes, kept_bytes: 0 };

        let magic: [u8; 4] = cursor.bytes("the magic number")?;
        if &magic != b"GGUF" {
            return Err(GgufError::Magic { path: path.to_owned(), found: magic.escape_ascii().to_string() });
        }
        let version = cursor.u32("the version")?;
        if !(2..=3).contains(&version) {
            return Err(GgufError::Version { path: path.to_owned(), version });
        }
        let tensor_count = cursor.u64("the tensor count")?;
        let metadata_count = cursor.u64("the metadata count")?;
        if tensor_count > TENSORS_MAX {
            return Err(cursor.malformed("the tensor count", format!("{tensor_count}, the limit is {TENSORS_MAX}")));
        }
        if metadata_count > METADATA_ENTRIES_MAX {
            let reason = format!("{metadata_count}, the limit is {METADATA_ENTRIES_MAX}");
            return Err(cursor.malformed("the metadata count", reason));
        }

        let mut metadata = BTreeMap::new();
        let mut vocabulary = Vec::new();
        for index in 0..metadata_count {
            let place = format!("metadata entry {index}");
            let key = cursor.text(&place)?;
            let value = cursor.value(&key, &mut vocabulary)?;
            if metadata.insert(key.clone(), value).is_some() {
                return Err(cursor.malformed(&key, "the key occurs twice"));
            }
        }
        let alignment = match metadata.get("general.alignment") {
            None => ALIGNMENT_BYTES_DEFAULT,
            Some(Value::Unsigned(bytes)) if bytes.is_power_of_two() && *bytes <= 1 << 20 => *bytes,
            Some(_) => return Err(cursor.malformed("general.alignment", "not a power of two up to 2^20")),
        };

        let mut tensors = Vec::new();
        let mut names = HashSet::new();
        for index in 0..tensor_count {
            let (tensor, offset) = cursor.tensor(index)?;
            if !names.insert(tensor.name.clone()) {
                return Err(cursor.malformed(&format!("tensor {:?}", tensor.name), "the name occurs twice"));
            }
            if offset % alignment != 0 {
                let reason = format!("its offset {offset} is no multiple of the alignment {alignment}");
                return Err(cursor.malformed(&format!("tensor {:?}", tensor.name), reason));
            }
            tensors.push((tensor, offset));
        }
        let data_start = cursor.position.next_multiple_of(alignment);
        let mut expected_offset = 0;
        let mut placed = Vec::with_capacity(tensors.len());
        for (mut tensor, offset) in tensors {
            let place = format!("tensor {:?}", tensor.name);
            // llama.cpp expects the tensors in the order of their descriptions, without gaps. Other offsets overlap or leave holes.
            if offset != expected_offset {
                return Err(
                    cursor.malformed(&place, format!("its data starts at {offset}, expected {expected_offset}"))
                );
            }
            tensor.start = data_start.saturating_add(offset);
            let needed = tensor.start.saturating_add(tensor.size_bytes);
            if needed > cursor.size_bytes {
                return Err(GgufError::Truncated {
                    path: path.to_owned(),
                    place,
                    needed,
                    size_bytes: cursor.size_bytes,
                });
            }
            expected_offset = (offset + tensor.size_bytes).next_multiple_of(alignment);
            placed.push(tensor);
        }
        Ok(Self { path: path.to_owned(), version, size_bytes, metadata, tensors: placed, vocabulary })
    }

    /// Reads the header and also checks that it describes a language model with a vocabulary that llama.cpp can load. A fault that would
    /// end the process there is an error here. If the model has several parts, all must be there; their tensors and sizes count together.
    ///
    /// # Errors
    ///
    /// As [`Header::read`], [`GgufError::NotALanguageModel`] and [`GgufError::Parts`].
    pub fn read_language_model(path: &Path) -> Result<Self, GgufError> {
        let mut header = Self::read(path)?;
        header.add_parts()?;
        header.check_language_model()?;
        Ok(header)
    }

    /// As [`Header::read_language_model`], for a file that may be one part of a model: the other parts may be missing.
    ///
    /// # Errors
    ///
    /// As [`Header::read_language_model`].
    pub fn read_download(path: &Path) -> Result<Self, GgufError> {
        let header = Self::read(path)?;
        if header.part().is_none() {
            header.check_language_model()?;
        }
        Ok(header)
    }

    /// The number of this part of the model, from 1, and the number of parts; `None` for a model in one file.
    fn part(&self) -> Option<(u64, u64)> {
        let count = self.unsigned("split.count").filter(|count| (2..=PARTS_MAX).contains(count))?;
        Some((self.unsigned("split.no").unwrap_or(0).saturating_add(1), count))
    }

    /// Adds the tensors of the other parts. Their names follow from the name of the first: `NAME-00001-of-00002.gguf`.
    fn add_parts(&mut self) -> Result<(), GgufError> {
        let Some((number, count)) = self.part() else { return Ok(()) };
        let fail = |reason: String| GgufError::Parts { path: self.path.clone(), number, count, reason };
        let name = self.path.file_name().unwrap_or_default().to_string_lossy();
        let ending = |number: u64| format!("-{number:05}-of-{count:05}.gguf");
        if self.holds_another().map_err(|source| GgufError::Io { path: self.path.clone(), source })? {
            return Err(fail(format!("the parts were joined with cat, which gives no model; {JOIN}")));
        }
        let Some(stem) = name.strip_suffix(&ending(number)) else {
            let own = ending(number);
            return Err(fail(format!(
                "its name does not end with {own}, so its parts were joined with cat or it was renamed; {JOIN}, or give each part its name back"
            )));
        };
        if number != 1 {
            return Err(fail(format!("give part 1, {stem}{}", ending(1))));
        }
        let mut added = Vec::new();
        for other in 2..=count {
            let path = self.path.with_file_name(format!("{stem}{}", ending(other)));
            if !path.exists() {
                return Err(fail(format!(
                    "part {other} of {count} is missing; put {} into the same folder",
                    path.display()
                )));
            }
            let header = Self::read(&path)?;
            if header.part() != Some((other, count)) {
                return Err(fail(format!(
                    "{} is not part {other} of {count}; copy or download it again",
                    path.display()
                )));
            }
            added.push(header);
        }
        for header in added {
            self.size_bytes = self.size_bytes.saturating_add(header.size_bytes);
            self.tensors.extend(header.tensors);
        }
        Ok(())
    }

    fn holds_another(&self) -> std::io::Result<bool> {
        let Some(end) = self.tensors.iter().map(|tensor| tensor.start.saturating_add(tensor.size_bytes)).max() else {
            return Ok(false);
        };
        // The end of the last tensor may be padded to the alignment.
        let mut behind = Vec::new();
        let mut file = open_plain(&self.path)?;
        file.seek(SeekFrom::Start(end))?;
        file.take(ALIGNMENT_BYTES_DEFAULT + 4).read_to_end(&mut behind)?;
        Ok(behind.windows(4).any(|window| window == b"GGUF"))
    }

    fn check_language_model(&self) -> Result<(), GgufError> {
        let refuse = |reason: String| Err(GgufError::NotALanguageModel { path: self.path.clone(), reason });
        if self.architecture().is_none() {
            return refuse("the text general.architecture is missing".into());
        }
        if self.tensors.is_empty() {
            return refuse("it has no tensors, only metadata".into());
        }
        if self.vocabulary.is_empty() {
            return refuse(format!("the vocabulary {VOCABULARY_KEY} is missing"));
        }
        let tokens = self.vocabulary.len() as u64;
        // llama.cpp renames an empty token by its number, so several of them are harmless.
        let mut seen = HashSet::with_capacity(self.vocabulary.len());
        for (index, token) in self.vocabulary.iter().enumerate() {
            // llama.cpp reads up to the first zero byte.
            let token = token.split(|byte| *byte == 0).next().unwrap_or_default();
            if !token.is_empty() && !seen.insert(token) {
                return refuse(format!(
                    "token {index} of the vocabulary, {:?}, occurs twice",
                    String::from_utf8_lossy(token)
                ));
            }
        }
        for (key, elements) in
            [("tokenizer.ggml.scores", ["f32", "i32"]), ("tokenizer.ggml.token_type", ["i32", "i32"])]
        {
            match self.metadata.get(key) {
                None => {}
                Some(Value::Array { element, length }) if elements.contains(element) && *length >= tokens => {}
                Some(other) => return refuse(format!("{key} is {other:?}, and the vocabulary has {tokens} tokens")),
            }
        }
        if self.text("tokenizer.ggml.model") == Some("llama") {
            // A sentencepiece tokenizer spells unknown characters in bytes, and looks up their tokens without a check that they exist.
            for byte in 0..=u8::MAX {
                if !seen.contains(format!("<0x{byte:02X}>").as_bytes()) && !seen.contains([byte].as_slice()) {
                    return refuse(format!("its sentencepiece vocabulary has no token for the byte 0x{byte:02X}"));
                }
            }
        }
        for key in ["bos", "eos", "unknown", "padding"].map(|name| format!("tokenizer.ggml.{name}_token_id")) {
            if let Some(id) = self.unsigned(&key).filter(|&id| id >= tokens && id != u64::from(u32::MAX)) {
                return refuse(format!("{key} is {id}, and the vocabulary has {tokens} tokens"));
            }
        }
        let Some(embedding) = self.tensors.iter().find(|tensor| tensor.name == "token_embd.weight") else {
            return refuse("the tensor token_embd.weight is missing".into());
        };
        if embedding.shape.get(1) != Some(&tokens) {
            return refuse(format!(
                "token_embd.weight has the shape {:?}, and the vocabulary has {tokens} tokens",
                embedding.shape
            ));
        }
        Ok(())
    }

    /// A text of the metadata.
    #[must_use]
    pub fn text(&self, key: &str) -> Option<&str> {
        match self.metadata.get(key) {
            Some(Value::Text(text)) => Some(text),
            _ => None,
        }
    }

    /// A non-negative number of the metadata.
    #[must_use]
    pub(crate) fn unsigned(&self, key: &str) -> Option<u64> {
        match self.metadata.get(key) {
            Some(Value::Unsigned(number)) => Some(*number),
            Some(Value::Signed(number)) => u64::try_from(*number).ok(),
            _ => None,
        }
    }

    /// A value of the metadata as text; for an array its type and length.
    #[must_use]
    pub fn written(&self, key: &str) -> Option<String> {
        Some(match self.metadata.get(key)? {
            Value::Unsigned(number) => number.to_string(),
            Value::Signed(number) => number.to_string(),
            // Most are of single precision, and would show excess digits.
            Value::Float(number) => (*number as f32).to_string(),
            Value::Bool(value) => value.to_string(),
            Value::Text(text) => text.clone(),
            Value::Array { element, length } => format!("an array of {length} {element}"),
        })
    }

    /// The architecture, such as `llama`.
    #[must_use]
    pub fn architecture(&self) -> Option<&str> {
        self.text("general.architecture")
    }

    /// A number of the architecture's own section, such as `context_length` for `llama.context_length`.
    #[must_use]
    pub fn architecture_number(&self, name: &str) -> Option<u64> {
        self.unsigned(&format!("{}.{name}", self.architecture()?))
    }

    /// Number of tokens of the vocabulary.
    #[must_use]
    pub fn vocabulary_size(&self) -> usize {
        self.vocabulary.len()
    }

    /// Number of weights over all tensors.
    #[must_use]
    pub fn parameters(&self) -> u64 {
        self.tensors.iter().fold(0, |sum, tensor| sum.saturating_add(tensor.elements))
    }

    /// The tensor types with their share of all weights (0 to 1), the largest first.
    #[must_use]
    pub fn quantisation(&self) -> Vec<(&'static str, f64)> {
        let mut elements = BTreeMap::new();
        for tensor in &self.tensors {
            *elements.entry(tensor.kind).or_insert(0.0) += tensor.elements as f64;
        }
        let total: f64 = elements.values().sum();
        let mut shares: Vec<_> = elements.into_iter().map(|(kind, count)| (kind, count / total)).collect();
        shares.sort_by(|a, b| b.1.total_cmp(&a.1));
        shares
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn text(out: &mut Vec<u8>, text: &str) {
        out.extend((text.len() as u64).to_le_bytes());
        out.extend(text.as_bytes());
    }

    fn text_entry(out: &mut Vec<u8>, key: &str, value: &str) {
        text(out, key);
        out.extend(TYPE_STRING.to_le_bytes());
        text(out, value);
    }

    /// The smallest file that passes: "gpt2" tokens without byte fallback, and their embedding of 32 values each.
    fn tiny(tokens: &[&str]) -> Vec<u8> {
        let mut out = b"GGUF".to_vec();
        out.extend(3_u32.to_le_bytes());
        out.extend(1_u64.to_le_bytes());
        out.extend(3_u64.to_le_bytes());
        text_entry(&mut out, "general.architecture", "llama");
        text_entry(&mut out, "tokenizer.ggml.model", "gpt2");
        text(&mut out, VOCABULARY_KEY);
        out.extend(TYPE_ARRAY.to_le_bytes());
        out.extend(TYPE_STRING.to_le_bytes());
        out.extend((tokens.len() as u64).to_le_bytes());
        for token in tokens {
            text(&mut out, token);
        }
        text(&mut out, "token_embd.weight");
        out.extend(2_u32.to_le_bytes());
        out.extend(32_u64.to_le_bytes());
        out.extend((tokens.len() as u64).to_le_bytes());
        out.extend(8_u32.to_le_bytes());
        out.extend(0_u64.to_le_bytes());
        out.resize(out.len().next_multiple_of(32) + 34 * tokens.len(), 0);
        out
    }

    fn read(bytes: &[u8]) -> Result<Header, GgufError> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), bytes).unwrap();
        Header::read_language_model(file.path())
    }

    #[test]
    fn the_smallest_model_is_read() {
        assert_eq!(tiny(&["a", "b", "c"]), include_bytes!("../../tests/data/tiny.gguf"));
        let header = read(&tiny(&["a", "b"])).unwrap();
        assert_eq!(header.architecture(), Some("llama"));
        assert_eq!(header.vocabulary_size(), 2);
        assert_eq!(header.parameters(), 64);
        assert_eq!(header.quantisation(), [("Q8_0", 1.0)]);
        assert_eq!(header.tensors[0].start % 32, 0);
    }

    /// The smallest model as part `number` of `count`; parts after the first have no vocabulary.
    fn part(number: u16, count: u16) -> Vec<u8> {
        let mut out = tiny(&["a", "b"]);
        let head = if number == 1 { out.split_off(24) } else { out.split_off(24)[..0].to_vec() };
        let entries: u64 = if number == 1 { 5 } else { 2 };
        out[16..24].copy_from_slice(&entries.to_le_bytes());
        for (key, value) in [("split.no", number - 1), ("split.count", count)] {
            text(&mut out, key);
            out.extend(2_u32.to_le_bytes());
            out.extend(value.to_le_bytes());
        }
        if number == 1 {
            let name = head.windows(17).position(|window| window == b"token_embd.weight").unwrap();
            out.extend(&head[..name + 17 + 4 + 16 + 4 + 8]);
        } else {
            text(&mut out, &format!("blk.{number}"));
            out.extend([1_u32.to_le_bytes(), 32_u32.to_le_bytes(), 0_u32.to_le_bytes(), 8_u32.to_le_bytes()].concat());
            out.extend(0_u64.to_le_bytes());
        }
        out.resize(out.len().next_multiple_of(32) + if number == 1 { 68 } else { 34 }, 0);
        out
    }

    #[test]
    fn models_in_parts_need_every_part() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let write = |name: &str, bytes: &[u8]| std::fs::write(at(name), bytes).unwrap();
        let read = |name: &str| Header::read_language_model(&at(name));
        let fault = |name: &str| read(name).unwrap_err().to_string();
        write("m-00001-of-00002.gguf", &part(1, 2));
        let missing = fault("m-00001-of-00002.gguf");
        assert!(
            missing.contains("part 2 of 2 is missing; put") && missing.contains("m-00002-of-00002.gguf"),
            "{missing}"
        );
        assert!(Header::read_download(&at("m-00001-of-00002.gguf")).is_ok());
        write("m-00002-of-00002.gguf", &part(1, 2));
        assert!(fault("m-00001-of-00002.gguf").contains("is not part 2 of 2"));
        write("m-00002-of-00002.gguf", &part(2, 2));
        assert_eq!(read("m-00001-of-00002.gguf").unwrap().parameters(), 96);
        assert!(fault("m-00002-of-00002.gguf").contains("give part 1, m-00001-of-00002.gguf"));
        assert!(Header::read_download(&at("m-00002-of-00002.gguf")).is_ok());
        write("joined.gguf", &[part(1, 2), part(2, 2)].concat());
        let joined = fault("joined.gguf");
        assert!(joined.contains("the parts were joined with cat") && joined.contains("--merge"), "{joined}");
        write("renamed.gguf", &part(1, 2));
        assert!(fault("renamed.gguf").contains("parts were joined with cat or it was renamed"));
    }

    #[test]
    fn every_truncation_is_an_error() {
        let whole = tiny(&["a", "b"]);
        for length in 0..whole.len() {
            let error = read(&whole[..length]).unwrap_err();
            assert!(matches!(error, GgufError::Truncated { .. }), "{length} bytes: {error}");
        }
    }

    #[test]
    fn other_files_are_named_as_such() {
        assert!(
            read(b"PK\x03\x04 a zip archive").unwrap_err().to_string().contains(r#""PK\x03\x04", not with "GGUF""#)
        );
        let mut old = tiny(&["a"]);
        old[4] = 1;
        assert!(matches!(read(&old).unwrap_err(), GgufError::Version { version: 1, .. }));
    }

    /// A FIFO would block this test for ever.
    #[test]
    fn what_is_no_plain_file_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let fifo = folder.path().join("fifo");
        let mode = rustix::fs::Mode::RUSR | rustix::fs::Mode::WUSR;
        rustix::fs::mknodat(rustix::fs::CWD, &fifo, rustix::fs::FileType::Fifo, mode, 0).unwrap();
        for path in [Path::new("/"), Path::new("/dev/null"), &fifo] {
            let error = Header::read(path).unwrap_err();
            assert!(error.to_string().contains("it is no plain file; check the path"), "{error}");
            assert!(crate::file_sha256(path).unwrap_err().to_string().contains("no plain file"));
        }
        assert!(matches!(Header::read(&folder.path().join("none")).unwrap_err(), GgufError::Io { .. }));
    }

    /// Each entry is within the limits, but their sum is not: of bytes that become three times as many, or of tokens without a byte.
    #[test]
    fn metadata_is_bounded_in_sum() {
        let mut many = b"GGUF".to_vec();
        many.extend(3_u32.to_le_bytes());
        many.extend(0_u64.to_le_bytes());
        many.extend(64_u64.to_le_bytes());
        let mut tokens = many.clone();
        for number in 0..64 {
            text(&mut many, &format!("key.{number}"));
            many.extend(TYPE_STRING.to_le_bytes());
            many.extend(STRING_BYTES_MAX.to_le_bytes());
            many.resize(many.len() + STRING_BYTES_MAX as usize, 0xff);
        }
        text(&mut tokens, VOCABULARY_KEY);
        tokens.extend(TYPE_ARRAY.to_le_bytes());
        tokens.extend(TYPE_STRING.to_le_bytes());
        tokens.extend(ARRAY_ELEMENTS_MAX.to_le_bytes());
        tokens.resize(tokens.len() + 8 * ARRAY_ELEMENTS_MAX as usize, 0);
        for (bytes, place) in [(many, "key.21"), (tokens, VOCABULARY_KEY)] {
            let error = read(&bytes).unwrap_err().to_string();
            assert!(
                error.contains(&format!("malformed at {place}: with it, keys, texts and tokens are more")),
                "{error}"
            );
        }
    }

    #[test]
    fn a_vocabulary_that_would_end_the_process_is_refused() {
        let error = read(&tiny(&["a", "a"])).unwrap_err().to_string();
        assert!(error.contains("token 1 of the vocabulary, \"a\", occurs twice"), "{error}");
        let error = read(&tiny(&["a", "a\0b"])).unwrap_err().to_string();
        assert!(error.contains("occurs twice"), "llama.cpp reads both as \"a\": {error}");
        // The same file lacks the byte tokens of a sentencepiece model.
        let bytes = tiny(&["a", "b"]);
        let at = bytes.windows(4).position(|window| window == b"gpt2").unwrap();
        let mut spm = bytes[..at - 8].to_vec();
        text(&mut spm, "llama");
        spm.extend(&bytes[at + 4..]);
        // The name is one byte longer, so the padding before the tensor data shrinks by one.
        let header_end =
            spm.windows(17).position(|window| window == b"token_embd.weight").unwrap() + 17 + 4 + 16 + 4 + 8;
        spm.remove(header_end);
        let error = read(&spm).unwrap_err().to_string();
        assert!(error.contains("no token for the byte 0x00"), "{error}");
    }

    #[test]
    fn a_length_beyond_the_file_is_not_believed() {
        let mut bytes = tiny(&["a"]);
        bytes[24..32].copy_from_slice(&(STRING_BYTES_MAX - 1).to_le_bytes());
        assert!(matches!(read(&bytes).unwrap_err(), GgufError::Truncated { .. }));
        bytes[24..32].copy_from_slice(&u64::MAX.to_le_bytes());
        assert!(matches!(read(&bytes).unwrap_err(), GgufError::Malformed { .. }));
    }

    proptest! {
        /// Damaged bytes may be read or refused, but never end the process.
        #[test]
        fn damage_never_panics(at in 0_usize..400, bytes in proptest::collection::vec(any::<u8>(), 1..16)) {
            let mut file = tiny(&["a", "b", "c"]);
            let at = at.min(file.len() - bytes.len());
            file[at..at + bytes.len()].copy_from_slice(&bytes);
            drop(read(&file));
        }
    }
}

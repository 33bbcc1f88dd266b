//! Checks the claimed sizes of a recording's chunks before one is unpacked: a few bytes can expand to gigabytes of zeros.

use mcap::MAGIC;
use mcap::records::op;

use super::{FILE_BYTES_MAX, RECORD_BYTES_MAX};

/// Bytes of a record before its content: kind and length.
const RECORD_HEAD: usize = 9;
/// The offset of the unpacked size in a chunk's header, after two times.
const SIZE_AT: usize = 16;

/// The reason why a recording is not unpacked.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum TooMuch {
    /// One chunk of this many bytes exceeds [`RECORD_BYTES_MAX`].
    Chunk(u64),
    /// All chunks together exceed [`FILE_BYTES_MAX`].
    All,
}

/// Rejects a recording if its complete chunks claim too many bytes. The reader unpacks no more of a chunk than it claims. The torn chunk of
/// a killed recorder claims none.
pub(super) fn check(recording: &[u8]) -> Result<(), TooMuch> {
    let mut rest = recording.strip_prefix(MAGIC).unwrap_or_default();
    let mut all = 0_u64;
    while let Some((head, later)) = rest.split_first_chunk::<RECORD_HEAD>() {
        let [opcode, length @ ..] = *head;
        let length = usize::try_from(u64::from_le_bytes(length)).ok();
        let Some((content, later)) = length.and_then(|length| later.split_at_checked(length)) else { break };
        rest = later;
        let size = content.get(SIZE_AT..).and_then(<[u8]>::first_chunk).filter(|_| opcode == op::CHUNK);
        let Some(size) = size.map(|size| u64::from_le_bytes(*size)) else { continue };
        if size > RECORD_BYTES_MAX as u64 {
            return Err(TooMuch::Chunk(size));
        }
        all = all.saturating_add(size);
        if all > FILE_BYTES_MAX {
            return Err(TooMuch::All);
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chunks_that_claim_too_much_are_refused() {
        let recording = |sizes: &[u64]| {
            let chunks = sizes.iter().flat_map(|size| {
                let content = [[0; SIZE_AT].as_slice(), &size.to_le_bytes(), &[0; 16]].concat();
                [&[op::CHUNK][..], &(content.len() as u64).to_le_bytes(), &content].concat()
            });
            MAGIC.iter().copied().chain(chunks).collect::<Vec<u8>>()
        };
        let most = RECORD_BYTES_MAX as u64;
        assert_eq!(check(&recording(&[most, 0])), Ok(()));
        assert_eq!(check(&recording(&[1, most + 1])), Err(TooMuch::Chunk(most + 1)));
        assert_eq!(check(&recording(&[most; 64])), Ok(()));
        assert_eq!(check(&recording(&[most; 65])), Err(TooMuch::All));
        // A chunk that is cut off is read up to its end.
        let torn = recording(&[u64::MAX]);
        assert_eq!(check(&torn[..torn.len() - 1]), Ok(()));
        assert_eq!(check(b"no recording"), Ok(()));
    }
}

//! The matrix products of an event alone, through ggml: a bound for what this processor can do with the same arithmetic.

use std::ffi::{CStr, CString};
use std::mem::transmute;
use std::os::unix::ffi::OsStrExt;
use std::path::Path;
use std::ptr::{null, null_mut};
use std::time::Instant;

use llama_cpp_sys_2 as ggml;

/// Every byte of weights and inputs: an ordinary number in each format. The time does not depend on the numbers.
const FILL: u8 = 0x3c;

struct Matrix {
    weights: *mut ggml::ggml_tensor,
    /// llama.cpp drops all tokens without logits before this matrix.
    for_logits: bool,
}

/// A dense model's matrices without their values, in ggml's fastest layout for this processor. They stay in memory until the bench ends.
pub struct Products {
    backend: ggml::ggml_backend_t,
    matrices: Vec<Matrix>,
    /// The width of all heads together, summed over the layers.
    attention_width: usize,
}

impl Products {
    /// llama.cpp must have loaded `model` before: it checks the file.
    pub fn new(model: &Path, threads: usize) -> Self {
        let path = CString::new(model.as_os_str().as_bytes()).expect("a path");
        let (mut tensors, mut named) = (null_mut(), Vec::new());
        // SAFETY: the texts end with zero, the context owns the tensors and is never freed, both functions have the types that ggml declares
        // for their names, and the list of layouts ends with a null pointer.
        let backend = unsafe {
            let parameters = ggml::gguf_init_params { no_alloc: true, ctx: &raw mut tensors };
            assert!(!ggml::gguf_init_from_file(path.as_ptr(), parameters).is_null(), "the model can be read");
            let mut next = ggml::ggml_get_first_tensor(tensors);
            while !next.is_null() {
                if ggml::ggml_n_dims(next) == 2 {
                    named.push((CStr::from_ptr(ggml::ggml_get_name(next)).to_string_lossy(), next));
                }
                next = ggml::ggml_get_next_tensor(tensors, next);
            }
            let device = ggml::ggml_backend_dev_by_type(ggml::GGML_BACKEND_DEVICE_TYPE_CPU);
            let backend = ggml::ggml_backend_dev_init(device, null());
            let registry = ggml::ggml_backend_dev_backend_reg(device);
            let find = |name: &CStr| ggml::ggml_backend_reg_get_proc_address(registry, name.as_ptr());
            let set_threads: ggml::ggml_backend_set_n_threads_t = transmute(find(c"ggml_backend_set_n_threads"));
            set_threads.expect("ggml has threads")(backend, threads as i32);
            let list: ggml::ggml_backend_dev_get_extra_bufts_t = transmute(find(c"ggml_backend_dev_get_extra_bufts"));
            // The last one repacks rows for vector units.
            let (mut layout, mut list) =
                (ggml::ggml_backend_dev_buffer_type(device), list.expect("ggml lists them")(device));
            while !(*list).is_null() {
                (layout, list) = (*list, list.add(1));
            }
            let buffer = ggml::ggml_backend_alloc_ctx_tensors_from_buft(tensors, layout);
            assert!(!buffer.is_null(), "the weights fit into memory");
            ggml::ggml_backend_buffer_clear(buffer, FILL);
            backend
        };
        // Tied embeddings are the matrix of the logits, too.
        let output = if named.iter().any(|(name, _)| name == "output.weight") { "output" } else { "token_embd" };
        let attentions: Vec<_> = named.iter().filter(|(name, _)| name.ends_with("attn_output.weight")).collect();
        // SAFETY: the tensors live.
        let attention_width = attentions.iter().map(|(_, weights)| unsafe { (**weights).ne[0] } as usize).sum();
        let last = format!("blk.{}.ffn", attentions.len().saturating_sub(1));
        let matrix = |(name, weights): (std::borrow::Cow<'_, str>, _)| {
            let for_logits = name.starts_with(output) || name.starts_with(&last);
            (for_logits || name.starts_with("blk.")).then_some(Matrix { weights, for_logits })
        };
        Self { backend, matrices: named.into_iter().filter_map(matrix).collect(), attention_width }
    }

    /// Input width, output width and columns of each product.
    fn shapes(&self, tokens: usize, rows: usize) -> impl Iterator<Item = [usize; 3]> {
        // SAFETY: the context of the weights is never freed.
        let widths = |matrix: &Matrix| unsafe { (*matrix.weights).ne };
        self.matrices.iter().map(move |matrix| {
            let [from, to, ..] = widths(matrix);
            [from as usize, to as usize, if matrix.for_logits { rows } else { tokens }]
        })
    }

    /// Multiplications and additions of [`time_ns`](Self::time_ns).
    pub fn operations(&self, tokens: usize, rows: usize) -> f64 {
        self.shapes(tokens, rows).map(|shape| 2.0 * shape.iter().product::<usize>() as f64).sum()
    }

    /// Multiplications and additions of attention: queries with keys, weights with values. `seen` counts each token's positions.
    pub fn attention_operations(&self, seen: usize) -> f64 {
        4.0 * seen as f64 * self.attention_width as f64
    }

    /// The time of one call with the products for `tokens` tokens, `rows` of them with logits.
    pub fn time_ns(&self, tokens: usize, rows: usize) -> u64 {
        let largest =
            self.shapes(tokens, rows).map(|[from, to, columns]| from.max(to) * columns * size_of::<f32>()).max();
        let half = largest.unwrap_or(0).next_multiple_of(64);
        let nodes = 2 * self.matrices.len();
        // SAFETY: the context has room for the tensors, the buffer for the largest input and the largest output, and ggml frees both once.
        unsafe {
            let mem_size = nodes * ggml::ggml_tensor_overhead() + ggml::ggml_graph_overhead_custom(nodes, false);
            let context = ggml::ggml_init(ggml::ggml_init_params { mem_size, mem_buffer: null_mut(), no_alloc: true });
            let graph = ggml::ggml_new_graph_custom(context, nodes, false);
            let buffer = ggml::ggml_backend_alloc_buffer(self.backend, 2 * half);
            let place = ggml::ggml_backend_buffer_get_base(buffer);
            for (matrix, [from, _, columns]) in self.matrices.iter().zip(self.shapes(tokens, rows)) {
                let input = ggml::ggml_new_tensor_2d(context, ggml::GGML_TYPE_F32, from as i64, columns as i64);
                let product = ggml::ggml_mul_mat(context, matrix.weights, input);
                // All in the same two places, which stay in the processor's cache, as llama.cpp reuses a small buffer.
                ggml::ggml_backend_tensor_alloc(buffer, input, place);
                ggml::ggml_backend_tensor_alloc(buffer, product, place.byte_add(half));
                ggml::ggml_build_forward_expand(graph, product);
            }
            ggml::ggml_backend_buffer_clear(buffer, FILL);
            let start = Instant::now();
            let status = ggml::ggml_backend_graph_compute(self.backend, graph);
            let time_ns = super::nanoseconds(start);
            assert_eq!(status, ggml::GGML_STATUS_SUCCESS, "ggml computes the products");
            ggml::ggml_backend_buffer_free(buffer);
            ggml::ggml_free(context);
            time_ns
        }
    }
}

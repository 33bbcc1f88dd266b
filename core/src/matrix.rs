//! A dense matrix, stored row by row.

use std::ops::{Index, IndexMut};

/// A rows x columns matrix.
#[derive(Debug, Clone, PartialEq)]
pub struct Matrix {
    rows: usize,
    columns: usize,
    values: Vec<f64>,
}

impl Matrix {
    /// Rows x columns of 0.
    #[must_use]
    pub fn zeros(rows: usize, columns: usize) -> Self {
        Self { rows, columns, values: vec![0.0; rows * columns] }
    }

    /// Rows x columns; `value` gets row and column.
    #[must_use]
    pub fn from_fn(rows: usize, columns: usize, value: impl Fn(usize, usize) -> f64) -> Self {
        let cells = (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column)));
        Self { rows, columns, values: cells.map(|(row, column)| value(row, column)).collect() }
    }

    /// The number of rows.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// The number of columns.
    #[must_use]
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// The values of a row. Panics if `row` is out of range.
    #[must_use]
    pub fn row(&self, row: usize) -> &[f64] {
        &self.values[row * self.columns..][..self.columns]
    }

    /// The values of a column, from the first row on.
    pub fn column(&self, column: usize) -> impl Iterator<Item = f64> + Clone {
        self.values.iter().skip(column).step_by(self.columns.max(1)).copied()
    }

    /// `out[c] = sum over r of self[(r, c)] * vector[r]`, with one value per column in `out`.
    pub fn transposed_product(&self, vector: &[f64], out: &mut [f64]) {
        out.fill(0.0);
        for (row, factor) in self.values.chunks_exact(self.columns.max(1)).zip(vector) {
            out.iter_mut().zip(row).for_each(|(sum, value)| *sum += factor * value);
        }
    }
}

impl Index<(usize, usize)> for Matrix {
    type Output = f64;

    fn index(&self, (row, column): (usize, usize)) -> &f64 {
        &self.values[row * self.columns + column]
    }
}

impl IndexMut<(usize, usize)> for Matrix {
    fn index_mut(&mut self, (row, column): (usize, usize)) -> &mut f64 {
        &mut self.values[row * self.columns + column]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_product_sums_the_rows() {
        let mut matrix = Matrix::from_fn(2, 3, |row, column| (10 * row + column) as f64);
        matrix[(0, 0)] = 5.0;
        let mut out = [1.0; 3];
        matrix.transposed_product(&[2.0, 1.0], &mut out);
        assert_eq!(out, [20.0, 13.0, 16.0]);
        assert_eq!((matrix.rows(), matrix.columns(), matrix.row(1)), (2, 3, &[10.0, 11.0, 12.0][..]));
        assert_eq!(matrix.column(1).collect::<Vec<_>>(), [1.0, 11.0]);
        assert_eq!(Matrix::zeros(3, 0).rows(), 3);
    }
}

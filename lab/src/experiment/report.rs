//! The output folder of an experiment: tables as CSV, charts as SVG and PNG, and one HTML page with all of them.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use super::chart::escape;

/// A table of text.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Table {
    /// Name of its CSV file, without ending.
    pub name: String,
    /// Its title.
    pub title: String,
    /// Names of the columns.
    pub header: Vec<String>,
    /// The rows.
    pub rows: Vec<Vec<String>>,
}

impl Table {
    /// An empty table.
    #[must_use]
    pub fn new(name: &str, title: &str, header: &[&str]) -> Self {
        let header = header.iter().map(|h| (*h).to_owned()).collect();
        Self { name: name.to_owned(), title: title.to_owned(), header, rows: Vec::new() }
    }

    /// Comma-separated values (RFC 4180).
    #[must_use]
    pub fn csv(&self) -> String {
        let field = |text: &String| {
            if text.contains([',', '"', '\n', '\r']) {
                format!("\"{}\"", text.replace('"', "\"\""))
            } else {
                text.clone()
            }
        };
        let line = |cells: &Vec<String>| cells.iter().map(field).collect::<Vec<_>>().join(",") + "\n";
        std::iter::once(&self.header).chain(&self.rows).map(line).collect()
    }

    fn html(&self) -> String {
        let mut html = format!("<h2>{}</h2><div class=\"table\"><table><tr>", escape(&self.title));
        for name in &self.header {
            // Writing to a string cannot fail.
            let _ = write!(html, "<th>{}</th>", escape(name));
        }
        html.push_str("</tr>");
        for row in &self.rows {
            html.push_str("<tr>");
            for cell in row {
                let _ = write!(html, "<td>{}</td>", escape(cell));
            }
            html.push_str("</tr>");
        }
        html + "</table></div>"
    }
}

/// The report of one experiment.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Report {
    /// The page's title.
    pub title: String,
    /// Paragraphs about method and result.
    pub notes: Vec<String>,
    /// Tables.
    pub tables: Vec<Table>,
    /// Names of files, without ending, and SVG text.
    pub figures: Vec<(String, String)>,
}

/// A report that could not be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReportError {
    /// A file could not be written.
    #[error("failed to write {path}: {source}; choose another folder with --out")]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// A figure could not become a PNG.
    #[cfg(feature = "png")]
    #[error(transparent)]
    Png(#[from] roomcast_simulation::png::PngError),
}

impl Report {
    /// The page with all figures inside, as a single file.
    #[must_use]
    pub fn html(&self) -> String {
        let title = escape(&self.title);
        let mut html = format!(
            "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\">\
             <title>{title}</title><style>{STYLE}</style></head><body><h1>{title}</h1>"
        );
        for note in &self.notes {
            let _ = write!(html, "<p>{}</p>", escape(note));
        }
        for (_, svg) in &self.figures {
            let _ = write!(html, "<figure>{svg}</figure>");
        }
        self.tables.iter().for_each(|table| html += &table.html());
        html + "</body></html>\n"
    }

    /// Writes every file into `folder`, which is created if it is missing.
    ///
    /// # Errors
    /// When the disk refuses or a figure cannot be rendered.
    pub fn write(&self, folder: &Path) -> Result<(), ReportError> {
        let put = |name: &str, bytes: &[u8]| {
            let path = folder.join(name);
            require_file(&path)
                .and_then(|()| std::fs::write(&path, bytes))
                .map_err(|source| ReportError::Write { path, source })
        };
        std::fs::create_dir_all(folder).map_err(|source| ReportError::Write { path: folder.to_owned(), source })?;
        for table in &self.tables {
            put(&format!("{}.csv", table.name), table.csv().as_bytes())?;
        }
        for (name, svg) in &self.figures {
            put(&format!("{name}.svg"), svg.as_bytes())?;
            #[cfg(feature = "png")]
            put(&format!("{name}.png"), &roomcast_simulation::png::png(svg, 2.0)?)?;
        }
        put("report.html", self.html().as_bytes())
    }
}

/// Rejects the place of a symbolic link, a FIFO or a device: a link may lead out of the folder, and a FIFO blocks.
fn require_file(path: &Path) -> std::io::Result<()> {
    match std::fs::symlink_metadata(path) {
        Ok(found) if !found.is_file() => Err(std::io::Error::other("it is no plain file; remove it")),
        _ => Ok(()),
    }
}

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;max-width:1100px;margin:2rem auto;padding:0 1rem;color:#222}\
h1{font-size:1.6rem}h2{font-size:1.15rem;margin-top:2rem}p{max-width:75ch}figure{margin:1.5rem 0}\
figure svg{max-width:100%;height:auto}.table{overflow-x:auto}table{border-collapse:collapse;font-size:13px}\
th,td{padding:.3rem .6rem;border-bottom:1px solid #ddd;text-align:right;white-space:nowrap}\
th:first-child,td:first-child,th:nth-child(2),td:nth-child(2){text-align:left}tr:hover{background:#f6f6f6}";

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::chart::{Chart, Mark, Series};

    #[test]
    fn a_report_is_one_page_and_its_parts() {
        let mut table = Table::new("numbers", "Numbers & more", &["name", "value"]);
        table.rows.push(vec!["a, \"b\"".into(), "<1>".into()]);
        let series = vec![Series { name: "s".into(), points: vec![(0.0, 0.0), (1.0, 1.0)], mark: Mark::Line }];
        let chart = Chart { title: "t".into(), x: "x".into(), y: "y".into(), series };
        let report = Report {
            title: "Report".into(),
            notes: vec!["A note.".into()],
            tables: vec![table],
            figures: vec![("chart".into(), chart.svg())],
        };
        let folder = tempfile::tempdir().unwrap();
        report.write(&folder.path().join("out")).unwrap();
        let read = |name: &str| std::fs::read(folder.path().join("out").join(name)).unwrap();
        assert_eq!(read("numbers.csv"), b"name,value\n\"a, \"\"b\"\"\",<1>\n");
        assert!(read("chart.svg").starts_with(b"<svg"));
        #[cfg(feature = "png")]
        assert!(read("chart.png").starts_with(b"\x89PNG"));
        // A link is not followed.
        std::fs::rename(folder.path().join("out/chart.svg"), folder.path().join("victim")).unwrap();
        std::os::unix::fs::symlink("../victim", folder.path().join("out/chart.svg")).unwrap();
        assert!(matches!(report.write(&folder.path().join("out")), Err(ReportError::Write { .. })));
        let html = String::from_utf8(read("report.html")).unwrap();
        assert!(html.contains("Numbers &amp; more") && html.contains("&lt;1&gt;") && html.contains("<svg"));
        assert!(
            !html.contains("http://") || html.matches("http://").count() == html.matches("http://www.w3.org").count()
        );
    }
}

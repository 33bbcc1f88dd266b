//! The output folder of an experiment: tables as CSV, charts as SVG and PNG, and one HTML page with all of them.

use std::path::Path;

use roomcast_cli::{Column, CommandResult, Failure};

use super::chart::escape;

#[derive(Debug, Clone, Default, PartialEq)]
pub struct Table {
    /// Name of its CSV file, without ending.
    pub name: String,
    pub title: String,
    pub header: Vec<String>,
    pub rows: Vec<Vec<String>>,
}

impl Table {
    pub fn new<H: Into<String>>(name: &str, title: &str, header: impl IntoIterator<Item = H>) -> Self {
        let header = header.into_iter().map(Into::into).collect();
        Self { name: name.to_owned(), title: title.to_owned(), header, rows: Vec::new() }
    }

    pub fn of<'r, R: 'r>(
        name: &str,
        title: &str,
        rows: impl IntoIterator<Item = &'r R>,
        columns: &[Column<'_, R>],
    ) -> Self {
        let mut table = Self::new(name, title, columns.iter().map(|(head, _)| *head));
        table.rows = rows.into_iter().map(|row| columns.iter().map(|(_, cell)| cell(row)).collect()).collect();
        table
    }

    fn lines(&self) -> impl Iterator<Item = &Vec<String>> {
        std::iter::once(&self.header).chain(&self.rows)
    }

    pub fn text(&self) -> String {
        let mut table = roomcast_cli::table(&self.header.iter().map(String::as_str).collect::<Vec<_>>());
        table.add_rows(&self.rows);
        table.to_string()
    }

    pub fn markdown(&self) -> String {
        let line = |cells: &Vec<String>| {
            let cells: Vec<String> = cells.iter().map(|cell| cell.replace('|', "\\|")).collect();
            format!("| {} |", cells.join(" | "))
        };
        let mut lines: Vec<String> = self.lines().map(line).collect();
        lines.insert(1, format!("|{}", " --- |".repeat(self.header.len())));
        lines.join("\n")
    }

    /// Comma-separated values (RFC 4180).
    fn csv(&self) -> String {
        let field = |text: &String| {
            if text.contains([',', '"', '\n', '\r']) {
                format!("\"{}\"", text.replace('"', "\"\""))
            } else {
                text.clone()
            }
        };
        self.lines().map(|cells| cells.iter().map(field).collect::<Vec<_>>().join(",") + "\n").collect()
    }

    fn html(&self) -> String {
        let line = |cells: &Vec<String>, tag: &str| {
            let cells: String = cells.iter().map(|cell| format!("<{tag}>{}</{tag}>", escape(cell))).collect();
            format!("<tr>{cells}</tr>")
        };
        let rows: String = self.rows.iter().map(|row| line(row, "td")).collect();
        let (title, header) = (escape(&self.title), line(&self.header, "th"));
        format!("<h2>{title}</h2><div class=\"table\"><table>{header}{rows}</table></div>")
    }
}

#[derive(Debug, Clone, Default, PartialEq)]
pub struct Report {
    pub title: String,
    /// Paragraphs about method and result.
    pub notes: Vec<String>,
    pub tables: Vec<Table>,
    /// Names of files, without ending, and SVG text.
    pub figures: Vec<(String, String)>,
}

impl Report {
    /// The page with all figures inside, as a single file.
    pub fn html(&self) -> String {
        let title = escape(&self.title);
        let notes: String = self.notes.iter().map(|note| format!("<p>{}</p>", escape(note))).collect();
        let figures: String = self.figures.iter().map(|(_, svg)| format!("<figure>{svg}</figure>")).collect();
        let tables: String = self.tables.iter().map(Table::html).collect();
        format!(
            "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\">\
             <title>{title}</title><style>{STYLE}</style></head><body><h1>{title}</h1>{notes}{figures}{tables}</body></html>\n"
        )
    }

    pub fn text(&self) -> String {
        let tables = self.tables.iter().map(|table| format!("\n{}\n{}\n", table.title, table.text()));
        format!("{}\n{}\n", tables.collect::<String>(), self.notes.join("\n"))
    }

    pub fn write(&self, folder: &Path) -> CommandResult {
        let put = |name: &str, bytes: &[u8]| {
            let path = folder.join(name);
            require_file(&path).and_then(|()| std::fs::write(&path, bytes)).map_err(|error| unwritten(&path, &error))
        };
        std::fs::create_dir_all(folder).map_err(|error| unwritten(folder, &error))?;
        for table in &self.tables {
            put(&format!("{}.csv", table.name), table.csv().as_bytes())?;
        }
        for (name, svg) in &self.figures {
            put(&format!("{name}.svg"), svg.as_bytes())?;
            #[cfg(feature = "png")]
            put(&format!("{name}.png"), &roomcast_simulation::png::png(svg, 2.0).map_err(Failure::failed)?)?;
        }
        put("report.html", self.html().as_bytes())?;
        roomcast_cli::tell(format_args!("roomcast: wrote {}", folder.join("report.html").display()));
        Ok(())
    }
}

fn unwritten(path: &Path, error: &std::io::Error) -> Failure {
    Failure::failed(format!("failed to write {}: {error}; choose another folder with --out", path.display()))
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
        let mut table = Table::new("numbers", "Numbers & more", ["name", "value"]);
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
        let failure = report.write(&folder.path().join("out")).unwrap_err();
        assert!(failure.to_string().contains("chart.svg: it is no plain file"), "{failure}");
        let html = String::from_utf8(read("report.html")).unwrap();
        assert!(html.contains("Numbers &amp; more") && html.contains("&lt;1&gt;") && html.contains("<svg"));
        assert!(
            !html.contains("http://") || html.matches("http://").count() == html.matches("http://www.w3.org").count()
        );
    }
}

//! The plots, as SVG without a library: a frame, a few marks on the axes, and lines or bars.

use std::fmt::Write as _;
use std::path::Path;

use crate::bench::Outcome;
use crate::record::Line;

const WIDTH: f64 = 720.0;
const HEIGHT: f64 = 320.0;
const LEFT: f64 = 60.0;
const RIGHT: f64 = 150.0;
const TOP: f64 = 30.0;
const BOTTOM: f64 = 45.0;
const COLORS: [&str; 5] = ["#1f6feb", "#d1242f", "#2da44e", "#9a6700", "#8250df"];
/// Marks on an axis.
const MARKS: u32 = 5;

/// A curve and its name.
type Curve = (String, Vec<(f64, f64)>);

/// Writes the plots that the lines are enough for; gives the text that shows them.
pub fn write(lines: &[Line], folder: &Path) -> Outcome<String> {
    std::fs::create_dir_all(folder)?;
    let mut text = String::new();
    for (file, title, svg) in all(lines) {
        std::fs::write(folder.join(file), svg)?;
        let _ = writeln!(text, "![{title}](performance/{file})\n");
    }
    if text.is_empty() {
        text.push_str("No case with a plot was measured.\n");
    }
    Ok(text)
}

fn all(lines: &[Line]) -> Vec<(&'static str, &'static str, String)> {
    let case = |name: &str| lines.iter().find(|line| line.case == name);
    let mut plots = Vec::new();
    if let Some(live) = case("live") {
        let title = "Throughput against live submissions";
        let curve = (
            "until Running".to_owned(),
            live.series.get("started/s by live").cloned().unwrap_or_default(),
        );
        plots.push((
            "throughput.svg",
            title,
            curves(title, "live submissions", "started per second", &[curve], &[]),
        ));
        let title = "Memory against live submissions";
        let memory = [("RSS", "RSS, MB, "), ("anonymous", "RSS (anonymous), MB, ")];
        let memory = memory.map(|(name, prefix)| (name.to_owned(), by_live(live, prefix)));
        plots.push((
            "memory.svg",
            title,
            curves(title, "live submissions", "MB", &memory, &[]),
        ));
    }
    let title = "Latency percentiles";
    let latencies = latencies(case("latency"), case("burst"));
    if !latencies.is_empty() {
        plots.push(("latency.svg", title, bars(title, "ms", &latencies)));
    }
    if let Some(burst) = case("burst-restart") {
        let title = "A burst with a restart in its middle";
        let counts = ["Jobs", "running", "finished"];
        let counts = counts.map(|name| (name.to_owned(), burst.series.get(name).cloned().unwrap_or_default()));
        let restarts: Vec<f64> = burst
            .series
            .get("restart")
            .into_iter()
            .flatten()
            .map(|(at, _)| *at)
            .collect();
        plots.push((
            "restart.svg",
            title,
            curves(title, "seconds", "submissions so far", &counts, &restarts),
        ));
    }
    plots
}

/// Figures whose names end in `<number> live`.
fn by_live(line: &Line, prefix: &str) -> Vec<(f64, f64)> {
    let figures = line.figures.iter().filter_map(|(name, summary)| {
        let live = name.strip_prefix(prefix)?.strip_suffix(" live")?;
        Some((live.parse().ok()?, summary.median))
    });
    let mut points: Vec<(f64, f64)> = figures.collect();
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    points
}

fn latencies(steady: Option<&Line>, burst: Option<&Line>) -> Vec<(String, f64)> {
    let mut found = Vec::new();
    let mut add = |line: Option<&Line>, figure: &str, name: &str| {
        for part in ["p50", "p99"] {
            let value = line.and_then(|line| line.median(&format!("{figure}, {part} ms")));
            found.extend(value.map(|value| (format!("{name}, {part}"), value)));
        }
    };
    add(steady, "limit, created to Job", "2/s: created to Job, limit");
    add(steady, "operator, created to Job", "2/s: created to Job, operator");
    add(steady, "end to Finished", "2/s: end to Finished");
    add(burst, "end observed to PATCH received", "burst: end to PATCH");
    add(burst, "end to Finished", "burst: end to Finished");
    found
}

fn frame(title: &str) -> String {
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" font-family=\"sans-serif\" \
         font-size=\"12\">\n<rect width=\"{WIDTH}\" height=\"{HEIGHT}\" fill=\"white\"/>\n<text x=\"{LEFT}\" y=\"18\" \
         font-size=\"14\">{title}</text>\n"
    )
}

/// Where the area of a plot is, and how values become places in it.
struct Area {
    far: f64,
    high: f64,
}

const WIDE: f64 = WIDTH - LEFT - RIGHT;
const TALL: f64 = HEIGHT - TOP - BOTTOM;

impl Area {
    fn at(&self, x: f64, y: f64) -> (f64, f64) {
        (LEFT + WIDE * x / self.far, TOP + TALL * (1.0 - y / self.high))
    }

    /// Numbers along both axes, and lines across.
    fn axes(&self, svg: &mut String) {
        for mark in 0..=MARKS {
            let part = f64::from(mark) / f64::from(MARKS);
            let ((x, low), (left, y)) = (self.at(self.far * part, 0.0), self.at(0.0, self.high * part));
            let (below, value) = (low + 16.0, self.far * part);
            let _ = writeln!(
                svg,
                "<text x=\"{x:.1}\" y=\"{below:.1}\" text-anchor=\"middle\">{value:.0}</text>"
            );
            let (before, beside, value) = (left - 6.0, y + 4.0, self.high * part);
            let _ = writeln!(
                svg,
                "<text x=\"{before:.1}\" y=\"{beside:.1}\" text-anchor=\"end\">{value:.0}</text>"
            );
            let _ = writeln!(svg, "<path d=\"M{left:.1} {y:.1}h{WIDE}\" stroke=\"#d0d7de\"/>");
        }
    }

    fn restarts(&self, svg: &mut String, marks: &[f64]) {
        for mark in marks {
            let (x, y) = self.at(*mark, self.high);
            let dashed = "stroke=\"black\" stroke-dasharray=\"4 3\"";
            let _ = writeln!(svg, "<path d=\"M{x:.1} {y:.1}v{TALL}\" {dashed}/>");
            let _ = writeln!(svg, "<text x=\"{:.1}\" y=\"{:.1}\">restart</text>", x + 4.0, y + 10.0);
        }
    }

    /// A line through all points, which are marked where they are few, and its name beside the plot.
    fn curve(&self, svg: &mut String, number: usize, (name, points): &Curve) {
        let color = COLORS[number % COLORS.len()];
        let places: Vec<(f64, f64)> = points.iter().map(|(x, y)| self.at(*x, *y)).collect();
        let path: Vec<String> = places.iter().map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
        let (path, style) = (path.join(" "), "fill=\"none\" stroke-width=\"2\"");
        let _ = writeln!(svg, "<polyline {style} stroke=\"{color}\" points=\"{path}\"/>");
        for (x, y) in places.iter().filter(|_| places.len() < 30) {
            let _ = writeln!(svg, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"3\" fill=\"{color}\"/>");
        }
        let (beside, line) = (WIDTH - RIGHT + 12.0, TOP + 14.0 + 18.0 * number as f64);
        let _ = writeln!(
            svg,
            "<text x=\"{beside:.1}\" y=\"{line:.1}\" fill=\"{color}\">{name}</text>"
        );
    }
}

fn curves(title: &str, across: &str, up: &str, curves: &[Curve], marks: &[f64]) -> String {
    let points = curves.iter().flat_map(|(_, points)| points);
    let (far, high) = points.fold((1.0, 1.0), |(x, y): (f64, f64), point| (x.max(point.0), y.max(point.1)));
    let area = Area { far, high };
    let mut svg = frame(title);
    area.axes(&mut svg);
    area.restarts(&mut svg, marks);
    for (number, curve) in curves.iter().enumerate() {
        area.curve(&mut svg, number, curve);
    }
    let (x, y) = (LEFT + WIDE / 2.0, HEIGHT - 8.0);
    let _ = writeln!(
        svg,
        "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"middle\">{across}</text>"
    );
    let turned = format!("transform=\"translate(14 {:.1}) rotate(-90)\"", TOP + TALL / 2.0);
    let _ = writeln!(svg, "<text {turned} text-anchor=\"middle\">{up}</text>\n</svg>");
    svg
}

/// Bars on a logarithmic scale: a burst and a calm minute differ by orders of magnitude.
fn bars(title: &str, unit: &str, values: &[(String, f64)]) -> String {
    let left = 240.0;
    let step = (HEIGHT - TOP - 15.0) / values.len() as f64;
    let highest = values.iter().fold(10.0, |high: f64, (_, value)| high.max(*value));
    let mut svg = frame(title);
    for (number, (name, value)) in values.iter().enumerate() {
        let y = TOP + step * number as f64;
        let part = (value.max(1.0).log10() / highest.log10()).max(0.005);
        let (wide, middle) = ((WIDTH - left - 90.0) * part, y + step / 2.0 + 4.0);
        let color = COLORS[number % 2];
        let _ = writeln!(
            svg,
            "<text x=\"{:.1}\" y=\"{middle:.1}\" text-anchor=\"end\">{name}</text>",
            left - 8.0
        );
        let _ = writeln!(
            svg,
            "<rect x=\"{left}\" y=\"{:.1}\" width=\"{wide:.1}\" height=\"{:.1}\" fill=\"{color}\"/>",
            y + 3.0,
            step - 6.0
        );
        let _ = writeln!(
            svg,
            "<text x=\"{:.1}\" y=\"{middle:.1}\">{value:.0} {unit}</text>",
            left + wide + 6.0
        );
    }
    svg.push_str("</svg>\n");
    svg
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::Figures;

    #[test]
    fn plots_are_made_of_what_was_measured() {
        let mut figures = Figures::default();
        for (live, memory) in [(1000, 30.0), (0, 20.0)] {
            figures.add(&format!("RSS, MB, {live} live"), memory);
        }
        figures.add("RSS, MB, 1000 live, after a restart", 99.0);
        figures
            .series
            .insert("started/s by live".into(), vec![(250.0, 10.0), (500.0, 20.0)]);
        let line = figures.into_line("live");
        assert_eq!(by_live(&line, "RSS, MB, "), [(0.0, 20.0), (1000.0, 30.0)]);
        let plots = all(&[line]);
        assert_eq!(plots.len(), 2);
        // The last of the two points is in the upper right corner of the frame.
        assert!(
            plots[0].2.contains("points=\"315.0,152.5 570.0,30.0\""),
            "{}",
            plots[0].2
        );
    }
}

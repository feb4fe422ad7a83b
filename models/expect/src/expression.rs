//! Signals as a person writes them: `theta`, `|x - 0.5|`, `error(p(theta))`, `rate(wrap(theta - pi))`.

use std::borrow::Cow;
use std::fmt;

use schemars::JsonSchema;
use serde::Deserialize;

use crate::samples::Samples;

/// Longest text of an expression, bytes; bounds how deep one can be.
const TEXT_MAX_BYTES: usize = 500;

/// A signal computed from what is seen of a plant, sample by sample.
#[derive(Clone, Debug, Deserialize, PartialEq)]
#[serde(try_from = "NumberOrText")]
pub struct Expression {
    text: String,
    node: Node,
}

/// A number, or an expression over the signals of the plant.
#[derive(Deserialize, JsonSchema)]
#[serde(untagged, expecting = "a number or an expression is needed")]
enum NumberOrText {
    Number(f64),
    Text(String),
}

impl JsonSchema for Expression {
    fn schema_name() -> Cow<'static, str> {
        "Expression".into()
    }

    fn json_schema(generator: &mut schemars::SchemaGenerator) -> schemars::Schema {
        NumberOrText::json_schema(generator)
    }
}

#[derive(Clone, Debug, PartialEq)]
enum Node {
    Number(f64),
    Time,
    Signal(String),
    Apply(Function, Vec<Node>),
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Function {
    Add,
    Subtract,
    Multiply,
    Divide,
    Negate,
    Abs,
    Sqrt,
    Sin,
    Cos,
    Wrap,
    Rate,
    Start,
    Min,
    Max,
    Norm,
}

impl Function {
    fn named(name: &str) -> Option<Self> {
        Some(match name {
            "abs" => Self::Abs,
            "sqrt" => Self::Sqrt,
            "sin" => Self::Sin,
            "cos" => Self::Cos,
            "wrap" => Self::Wrap,
            "rate" => Self::Rate,
            "start" => Self::Start,
            "min" => Self::Min,
            "max" => Self::Max,
            "norm" => Self::Norm,
            _ => return None,
        })
    }

    /// One argument, or at least one.
    fn takes(self, count: usize) -> bool {
        match self {
            Self::Min | Self::Max | Self::Norm => count >= 1,
            _ => count == 1,
        }
    }
}

/// Quantities that name what they belong to, as in `p(theta)`.
const QUANTITIES: [&str; 7] = ["q", "p", "v", "velocity", "u", "force", "y"];

impl Expression {
    /// Reads an expression.
    pub fn parse(text: &str) -> Result<Self, String> {
        if text.len() > TEXT_MAX_BYTES {
            return Err(format!("the expression is longer than {TEXT_MAX_BYTES} bytes"));
        }
        let mut parser = Parser { text, at: 0 };
        let node = parser.sum()?;
        parser.skip_space();
        match parser.rest().chars().next() {
            None => Ok(Self { text: text.trim().to_owned(), node }),
            Some(c) => Err(parser.error(&format!("`{c}` is not expected"))),
        }
    }

    /// Its value at every sample.
    ///
    /// # Errors
    /// A signal that there is not, by name.
    pub fn values(&self, samples: &Samples) -> Result<Vec<f64>, String> {
        self.node.values(samples)
    }

    /// Whether it needs the energies.
    pub fn uses_energy(&self) -> bool {
        self.node.any(&|name| ["energy", "kinetic", "potential"].contains(&name))
    }
}

impl fmt::Display for Expression {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

impl TryFrom<NumberOrText> for Expression {
    type Error = String;

    fn try_from(given: NumberOrText) -> Result<Self, String> {
        match given {
            NumberOrText::Number(x) => {
                let is_plain = x == 0.0 || (1e-4..1e7).contains(&x.abs());
                let text = if is_plain { x.to_string() } else { format!("{x:e}") };
                Ok(Self { text, node: Node::Number(x) })
            }
            NumberOrText::Text(text) => Self::parse(&text),
        }
    }
}

impl Node {
    fn any(&self, is_wanted: &dyn Fn(&str) -> bool) -> bool {
        match self {
            Self::Number(_) | Self::Time => false,
            Self::Signal(name) => is_wanted(name),
            Self::Apply(_, arguments) => arguments.iter().any(|node| node.any(is_wanted)),
        }
    }

    fn values(&self, samples: &Samples) -> Result<Vec<f64>, String> {
        let (function, arguments) = match self {
            Self::Number(x) => return Ok(vec![*x; samples.count()]),
            Self::Time => return Ok(samples.time_s().to_vec()),
            Self::Signal(name) => return samples.signal(name),
            Self::Apply(function, arguments) => (*function, arguments),
        };
        let columns: Vec<_> =
            arguments.iter().map(|node| node.values(samples)).collect::<Result<_, _>>()?;
        if function == Function::Rate {
            return Ok(rate(samples.time_s(), &columns[0]));
        }
        if function == Function::Start {
            return Ok(vec![columns[0].first().copied().unwrap_or(f64::NAN); samples.count()]);
        }
        let row = |k: usize| function.of(columns.iter().map(|column| column[k]));
        Ok((0..samples.count()).map(row).collect())
    }
}

impl Function {
    /// The value for these arguments, of which there are as many as it takes. NaN stays NaN.
    fn of(self, mut arguments: impl Iterator<Item = f64>) -> f64 {
        let a = arguments.next().unwrap_or(f64::NAN);
        let either = |is_better: fn(f64, f64) -> bool| {
            move |a: f64, b: f64| if a.is_nan() || is_better(a, b) { a } else { b }
        };
        match self {
            Self::Add => arguments.fold(a, |a, b| a + b),
            Self::Subtract => arguments.fold(a, |a, b| a - b),
            Self::Multiply => arguments.fold(a, |a, b| a * b),
            Self::Divide => arguments.fold(a, |a, b| a / b),
            Self::Negate => -a,
            Self::Abs => a.abs(),
            Self::Sqrt => a.sqrt(),
            Self::Sin => a.sin(),
            Self::Cos => a.cos(),
            Self::Wrap => wrap(a),
            Self::Rate | Self::Start => f64::NAN,
            Self::Min => arguments.fold(a, either(|a, b| a <= b)),
            Self::Max => arguments.fold(a, either(|a, b| a >= b)),
            Self::Norm => arguments.fold(a.abs(), f64::hypot),
        }
    }
}

/// The angle between -pi and pi that differs by whole turns.
fn wrap(angle: f64) -> f64 {
    use std::f64::consts::{PI, TAU};
    let rest = angle.rem_euclid(TAU);
    if rest > PI { rest - TAU } else { rest }
}

/// Mean rate of change over the step that led to each sample; the first has that of the second.
fn rate(time_s: &[f64], values: &[f64]) -> Vec<f64> {
    let between = |k: usize| (values[k] - values[k - 1]) / (time_s[k] - time_s[k - 1]);
    let rates: Vec<_> = (1..values.len()).map(between).collect();
    let first = rates.first().copied().or(values.first().map(|_| 0.0));
    first.into_iter().chain(rates).collect()
}

/// Recursive descent:
/// `sum = product {(+|-) product}`, `product = factor {(*|/) factor}`,
/// `factor = - factor | number | name | name(sum, ...) | (sum) | |sum|`.
struct Parser<'a> {
    text: &'a str,
    at: usize,
}

impl<'a> Parser<'a> {
    fn rest(&self) -> &'a str {
        &self.text[self.at..]
    }

    fn skip_space(&mut self) {
        self.at = self.text.len() - self.rest().trim_start().len();
    }

    fn error(&self, what: &str) -> String {
        format!(
            "{what} at character {} of `{}`",
            self.text[..self.at].chars().count() + 1,
            self.text
        )
    }

    fn take(&mut self, token: char) -> bool {
        self.skip_space();
        let is_there = self.rest().starts_with(token);
        if is_there {
            self.at += token.len_utf8();
        }
        is_there
    }

    fn expect(&mut self, token: char) -> Result<(), String> {
        if self.take(token) { Ok(()) } else { Err(self.error(&format!("`{token}` is missing"))) }
    }

    fn sum(&mut self) -> Result<Node, String> {
        let mut node = self.product()?;
        loop {
            let function = match () {
                () if self.take('+') => Function::Add,
                () if self.take('-') => Function::Subtract,
                () => return Ok(node),
            };
            node = Node::Apply(function, vec![node, self.product()?]);
        }
    }

    fn product(&mut self) -> Result<Node, String> {
        let mut node = self.factor()?;
        loop {
            let function = match () {
                () if self.take('*') => Function::Multiply,
                () if self.take('/') => Function::Divide,
                () => return Ok(node),
            };
            node = Node::Apply(function, vec![node, self.factor()?]);
        }
    }

    fn factor(&mut self) -> Result<Node, String> {
        if self.take('-') {
            return Ok(Node::Apply(Function::Negate, vec![self.factor()?]));
        }
        if self.take('(') {
            let node = self.sum()?;
            self.expect(')')?;
            return Ok(node);
        }
        if self.take('|') {
            let node = self.sum()?;
            self.expect('|')?;
            return Ok(Node::Apply(Function::Abs, vec![node]));
        }
        self.skip_space();
        if self.rest().starts_with(|c: char| c.is_ascii_digit() || c == '.') {
            return self.number();
        }
        let start = self.at;
        let is_quoted = self.rest().starts_with('\'');
        let name = self.name()?;
        if !is_quoted && self.take('(') {
            return self.call(&name, start);
        }
        Ok(match name.as_str() {
            "t" if !is_quoted => Node::Time,
            "pi" if !is_quoted => Node::Number(std::f64::consts::PI),
            _ => Node::Signal(name),
        })
    }

    /// What follows `name(`.
    fn call(&mut self, name: &str, start: usize) -> Result<Node, String> {
        if QUANTITIES.contains(&name) {
            let of = self.name()?;
            self.expect(')')?;
            return Ok(Node::Signal(format!("{name}({of})")));
        }
        if ["ref", "error"].contains(&name) {
            let mut of = self.name()?;
            if QUANTITIES.contains(&of.as_str()) && self.take('(') {
                of = format!("{of}({})", self.name()?);
                self.expect(')')?;
            }
            self.expect(')')?;
            return Ok(Node::Signal(format!("{name}.{of}")));
        }
        let unknown = Self { text: self.text, at: start };
        let function = Function::named(name)
            .ok_or_else(|| unknown.error(&format!("there is no function `{name}`")))?;
        let mut arguments = vec![self.sum()?];
        while self.take(',') {
            arguments.push(self.sum()?);
        }
        self.expect(')')?;
        if !function.takes(arguments.len()) {
            return Err(unknown.error(&format!("`{name}` takes one argument")));
        }
        Ok(Node::Apply(function, arguments))
    }

    fn number(&mut self) -> Result<Node, String> {
        let rest = self.rest();
        let is_part = |(i, c): (usize, char)| {
            let after_exponent = i > 0 && matches!(rest.as_bytes()[i - 1], b'e' | b'E');
            c.is_ascii_digit()
                || matches!(c, '.' | 'e' | 'E')
                || (after_exponent && "+-".contains(c))
        };
        let end = rest.char_indices().find(|&c| !is_part(c)).map_or(rest.len(), |(i, _)| i);
        let number = rest[..end].parse();
        let number =
            number.map_err(|_| self.error(&format!("`{}` is not a number", &rest[..end])))?;
        self.at += end;
        Ok(Node::Number(number))
    }

    /// A plain name, or any name in single quotes.
    fn name(&mut self) -> Result<String, String> {
        if self.take('\'') {
            let rest = self.rest();
            let end = rest.find('\'').ok_or_else(|| self.error("the quote does not end"))?;
            self.at += end + 1;
            return Ok(rest[..end].to_owned());
        }
        let rest = self.rest();
        let is_part = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '.');
        let end = rest.find(|c| !is_part(c)).unwrap_or(rest.len());
        if end == 0 {
            return Err(self.error("a name or a number is missing"));
        }
        self.at += end;
        Ok(rest[..end].to_owned())
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;

    fn samples() -> Samples {
        let mut samples = Samples::default();
        for (name, values) in [
            ("q(theta)", [0.5, -2.0, 7.0]),
            ("p(theta)", [1.0, 2.0, 4.0]),
            ("u(tau)", [3.0, 3.0, f64::NAN]),
            ("q(left-arm)", [1.0, 1.0, 1.0]),
            ("ref.q(theta)", [0.0, 1.0, 2.0]),
            ("error.p(theta)", [8.0, 8.0, 8.0]),
        ] {
            samples.put(name, values.to_vec());
        }
        samples.put_time(vec![0.0, 0.5, 1.0]);
        samples
    }

    #[track_caller]
    fn values(text: &str) -> [f64; 3] {
        let values = Expression::parse(text).unwrap().values(&samples()).unwrap();
        values.try_into().unwrap()
    }

    #[test]
    fn expressions_have_the_values_of_arithmetic() {
        for (text, expected) in [
            ("theta", [0.5, -2.0, 7.0]),
            ("q(theta) - -1", [1.5, -1.0, 8.0]),
            ("1 - 2 - 3 + 2*3/4", [-2.5; 3]),
            ("-(theta + 1e0) * 2.5E+1", [-37.5, 25.0, -200.0]),
            ("|theta| - ||theta| - 1|", [0.0, 1.0, 1.0]),
            ("max(theta, 0, 1) + min(theta, p(theta))", [1.5, -1.0, 11.0]),
            ("norm(theta * 0 + 3, 4)", [5.0; 3]),
            ("'left-arm' + q('left-arm')", [2.0; 3]),
            ("ref(theta) + error(p(theta))", [8.0, 9.0, 10.0]),
            ("rate(theta)", [-5.0, -5.0, 18.0]),
            ("t * 2", [0.0, 1.0, 2.0]),
            ("theta - start(theta)", [0.0, -2.5, 6.5]),
            ("wrap(pi * 2 + 0.25 - t * 0)", [0.25; 3]),
            ("sqrt(cos(0) + sin(0) + 3)", [2.0; 3]),
            ("abs(-.5)", [0.5; 3]),
        ] {
            for (actual, expected) in values(text).into_iter().zip(expected) {
                assert!((actual - expected).abs() < 1e-14, "{text}: {actual} is not {expected}");
            }
        }
        assert_eq!(wrap(-PI), PI);
        assert!(values("wrap(theta)")[2] < 1.0);
        let tau = values("max(tau, 0)");
        assert!(tau[0] == 3.0 && tau[2].is_nan() && values("min(0, tau)")[2].is_nan());
    }

    #[test]
    fn errors_are_named_with_their_place() {
        for (text, part) in [
            ("", "a name or a number is missing at character 1"),
            ("theta +", "missing at character 8"),
            ("(theta", "`)` is missing"),
            ("|theta", "`|` is missing"),
            ("theta theta", "`t` is not expected at character 7"),
            ("speed(theta)", "no function `speed` at character 1"),
            ("sin(1, 2)", "`sin` takes one argument"),
            ("1.2.3", "`1.2.3` is not a number"),
            ("'a", "the quote does not end"),
            (&"-".repeat(501), "longer than 500"),
        ] {
            let error = Expression::parse(text).unwrap_err();
            assert!(error.contains(part), "{text}: {error}");
        }
        let missing = Expression::parse("phi + 1").unwrap().values(&samples()).unwrap_err();
        assert!(missing.contains("`phi`") && missing.contains("theta"), "{missing}");
    }

    #[test]
    fn energy_is_asked_for_only_where_it_is_used() {
        assert!(Expression::parse("|energy - 3|").unwrap().uses_energy());
        assert!(!Expression::parse("|theta - 3|").unwrap().uses_energy());
    }
}

//! Whether objects for Kubernetes are what its published schemas say, no field more: `tests/schemas/kubernetes.json`, which
//! `tests/schemas/make.py` makes.

use serde_json::{Map, Value};

const FILE: &str = include_str!("../schemas/kubernetes.json");

/// The schemas of what `deploy/kubernetes` has.
#[derive(Debug)]
pub struct Schemas {
    roots: Map<String, Value>,
    definitions: Map<String, Value>,
}

impl Default for Schemas {
    fn default() -> Self {
        Self::new()
    }
}

impl Schemas {
    /// Reads them.
    ///
    /// # Panics
    /// If the file is damaged.
    pub fn new() -> Self {
        let mut file: Map<String, Value> = serde_json::from_str(FILE).expect("JSON");
        let mut part = |name| match file.remove(name) {
            Some(Value::Object(part)) => part,
            _ => panic!("kubernetes.json has no {name}"),
        };
        Self { roots: part("roots"), definitions: part("$defs") }
    }

    /// All that is wrong with an object.
    pub fn problems(&self, object: &Value) -> Vec<String> {
        let field = |name| object[name].as_str().unwrap_or_default();
        let (version, kind) = (field("apiVersion"), field("kind"));
        let Some(root) = self.roots.get(&format!("{version} {kind}")) else {
            return vec![format!("kind is `{kind}` of `{version}`, allowed are {:?}", self.roots.keys())];
        };
        let mut problems = Vec::new();
        self.check(&self.definitions[root.as_str().unwrap_or_default()], object, kind, &mut problems);
        problems
    }

    fn check(&self, schema: &Value, value: &Value, at: &str, problems: &mut Vec<String>) {
        for (keyword, wanted) in schema.as_object().unwrap_or_else(|| panic!("{at}: a schema is an object: {schema}")) {
            match keyword.as_str() {
                "$ref" => {
                    let name = wanted.as_str().and_then(|name| name.strip_prefix("#/$defs/"));
                    let definition = name.and_then(|name| self.definitions.get(name));
                    self.check(definition.unwrap_or_else(|| panic!("{at}: no {wanted}")), value, at, problems);
                }
                "type" | "format" | "enum" | "const" if !fits(keyword, wanted, value) => {
                    problems.push(format!("{at} is {value}, allowed is {wanted}"));
                }
                "anyOf" => {
                    let fits = |choice| {
                        let mut problems = Vec::new();
                        self.check(choice, value, at, &mut problems);
                        problems.is_empty()
                    };
                    if !list(wanted).iter().any(fits) {
                        problems.push(format!("{at} is {value}, allowed is any of {wanted}"));
                    }
                }
                "required" => {
                    let missing = |name: &&Value| value.get(name.as_str().unwrap_or_default()).is_none();
                    let missing = list(wanted).iter().filter(missing);
                    problems.extend(missing.map(|name| format!("{at} has no {name}")));
                }
                "items" => {
                    for (index, item) in list(value).iter().enumerate() {
                        self.check(wanted, item, &format!("{at}[{index}]"), problems);
                    }
                }
                "properties" => {
                    for (name, value) in value.as_object().into_iter().flatten() {
                        if let Some(schema) = wanted.get(name) {
                            self.check(schema, value, &format!("{at}.{name}"), problems);
                        }
                    }
                }
                "additionalProperties" => {
                    let others = value.as_object().into_iter().flatten();
                    let known = |name: &str| schema.get("properties").is_some_and(|known| known.get(name).is_some());
                    for (name, value) in others.filter(|(name, _)| !known(name)) {
                        match wanted {
                            Value::Bool(false) => problems.push(format!("{at} has no field `{name}`")),
                            schema => self.check(schema, value, &format!("{at}.{name}"), problems),
                        }
                    }
                }
                "type" | "format" | "enum" | "const" => {}
                // Better none than a check that is not made.
                unknown => panic!("{at}: unknown keyword `{unknown}`"),
            }
        }
    }
}

fn list(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

fn fits(keyword: &str, wanted: &Value, value: &Value) -> bool {
    match (keyword, wanted.as_str().unwrap_or_default()) {
        ("type", "object") => value.is_object(),
        ("type", "array") => value.is_array(),
        ("type", "string") => value.is_string(),
        ("type", "boolean") => value.is_boolean(),
        ("type", "integer") | ("format", "int64") => value.is_i64(),
        ("type", "number") => value.is_number(),
        ("format", "int32") => value.as_i64().is_some_and(|number| i32::try_from(number).is_ok()),
        ("enum", _) => list(wanted).contains(value),
        ("const", _) => value == wanted,
        _ => panic!("unknown {keyword} {wanted}"),
    }
}

//! Renders a directory of `deploy/kubernetes` as `kubectl kustomize` does: of Kustomize what is used there. Whatever else a
//! file asks for is an error, so that what is tested is what is applied.

use std::fs;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde_json::{Map, Value, json};

#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
struct Kustomization {
    api_version: String,
    kind: String,
    #[serde(default)]
    resources: Vec<PathBuf>,
    #[serde(default)]
    images: Vec<Image>,
    #[serde(default)]
    config_map_generator: Vec<ConfigMap>,
    #[serde(default)]
    patches: Vec<Patch>,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
struct Image {
    name: String,
    new_name: Option<String>,
    new_tag: Option<String>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct ConfigMap {
    name: String,
    files: Vec<PathBuf>,
    /// `replace` where a resource has one of this name.
    behavior: Option<String>,
    options: GeneratorOptions,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
struct GeneratorOptions {
    disable_name_suffix_hash: bool,
    #[serde(default)]
    immutable: bool,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Patch {
    target: Target,
    patch: String,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Target {
    kind: String,
    name: String,
}

/// A step of RFC 6902.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Step {
    op: String,
    path: String,
    #[serde(default)]
    value: Value,
}

/// The objects of `dir`, whose `kustomization.yaml` says which.
///
/// # Errors
/// A file that is not there, is not YAML, or asks for more than is known here.
pub fn render(dir: &Path) -> Result<Vec<Value>, String> {
    let file = dir.join("kustomization.yaml");
    let wrong = |problem: String| format!("{}: {problem}", file.display());
    let kustomization: Kustomization =
        serde_saphyr::from_str(&read(&file)?).map_err(|error| wrong(error.to_string()))?;
    if (kustomization.api_version.as_str(), kustomization.kind.as_str())
        != ("kustomize.config.k8s.io/v1beta1", "Kustomization")
    {
        return Err(wrong(format!("it is a {} of {}", kustomization.kind, kustomization.api_version)));
    }
    let mut objects = Vec::new();
    for resource in &kustomization.resources {
        let path = dir.join(resource);
        objects.extend(if path.is_dir() { render(&path)? } else { documents(&path)? });
    }
    for generator in &kustomization.config_map_generator {
        let object = config_map(dir, generator).map_err(&wrong)?;
        let same = |other: &Value| other["kind"] == "ConfigMap" && other["metadata"]["name"] == *generator.name;
        let before = objects.iter().position(same);
        match (generator.behavior.as_deref(), before) {
            (None, None) => objects.push(object),
            (Some("replace"), Some(at)) => objects[at] = object,
            (behavior, _) => return Err(wrong(format!("{}: behavior is {behavior:?}", generator.name))),
        }
    }
    for patch in &kustomization.patches {
        let target = |object: &&mut Value| {
            object["kind"] == *patch.target.kind && object["metadata"]["name"] == *patch.target.name
        };
        let target = objects.iter_mut().find(target).ok_or_else(|| wrong(format!("no {:?}", patch.target)))?;
        let steps: Vec<Step> = serde_saphyr::from_str(&patch.patch).map_err(|error| wrong(error.to_string()))?;
        for step in steps {
            apply(target, &step).ok_or_else(|| wrong(format!("this does not apply: {step:?}")))?;
        }
    }
    for image in &kustomization.images {
        for object in &mut objects {
            set_image(object, image);
        }
    }
    Ok(objects)
}

/// The objects of a file, as they stand.
///
/// # Errors
/// It cannot be read, or is not YAML.
pub fn documents(file: &Path) -> Result<Vec<Value>, String> {
    serde_saphyr::from_multiple(&read(file)?).map_err(|error| format!("{}: {error}", file.display()))
}

fn read(file: &Path) -> Result<String, String> {
    fs::read_to_string(file).map_err(|error| format!("{}: {error}", file.display()))
}

fn config_map(dir: &Path, generator: &ConfigMap) -> Result<Value, String> {
    if !generator.options.disable_name_suffix_hash {
        return Err(format!("{}: a JobSet does not follow a name with a hash", generator.name));
    }
    let mut data = Map::new();
    for file in &generator.files {
        let name = file.file_name().ok_or("a file without a name")?.to_string_lossy().into_owned();
        data.insert(name, read(&dir.join(file))?.into());
    }
    let mut object =
        json!({ "apiVersion": "v1", "kind": "ConfigMap", "metadata": { "name": generator.name }, "data": data });
    if generator.options.immutable {
        object["immutable"] = true.into();
    }
    Ok(object)
}

/// None if it does not apply.
fn apply(object: &mut Value, step: &Step) -> Option<()> {
    let (parent, last) = step.path.rsplit_once('/')?;
    let last = last.replace("~1", "/").replace("~0", "~");
    match (step.op.as_str(), object.pointer_mut(parent)?) {
        ("test", parent) => (*child(parent, &last)? == step.value).then_some(()),
        ("replace", parent) => {
            *child(parent, &last)? = step.value.clone();
            Some(())
        }
        ("add", Value::Object(parent)) => {
            parent.insert(last, step.value.clone());
            Some(())
        }
        ("add", Value::Array(parent)) => {
            let at = if last == "-" { parent.len() } else { last.parse().ok()? };
            (at <= parent.len()).then(|| parent.insert(at, step.value.clone()))
        }
        _ => None,
    }
}

fn child<'a>(parent: &'a mut Value, name: &str) -> Option<&'a mut Value> {
    match parent {
        Value::Object(parent) => parent.get_mut(name),
        Value::Array(parent) => parent.get_mut(name.parse::<usize>().ok()?),
        _ => None,
    }
}

/// Wherever there are containers below `value`.
fn set_image(value: &mut Value, image: &Image) {
    match value {
        Value::Array(values) => values.iter_mut().for_each(|value| set_image(value, image)),
        Value::Object(fields) => {
            for (name, value) in fields {
                if name == "containers" || name == "initContainers" {
                    let containers = value.as_array_mut().into_iter().flatten();
                    containers
                        .filter_map(|container| container.get_mut("image"))
                        .for_each(|value| rename(value, image));
                }
                set_image(value, image);
            }
        }
        _ => {}
    }
}

fn rename(value: &mut Value, image: &Image) {
    let Some(text) = value.as_str() else { return };
    // A colon before the last slash is a port's.
    let (name, tag) = match text.rsplit_once(':') {
        Some((name, tag)) if !tag.contains('/') => (name, Some(tag)),
        _ => (text, None),
    };
    if name != image.name {
        return;
    }
    let name = image.new_name.as_deref().unwrap_or(name);
    *value = image.new_tag.as_deref().or(tag).map_or_else(|| name.to_owned(), |tag| format!("{name}:{tag}")).into();
}

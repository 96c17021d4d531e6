//! The jobs of rendered manifests.

use serde_json::{Value, json};

/// A text, empty where it is none.
pub fn text(value: &Value) -> &str {
    value.as_str().unwrap_or_default()
}

/// A list, empty where it is none.
pub fn list(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

/// A job of the manifests, and the pods that it makes.
#[derive(Debug)]
pub struct Job<'a> {
    /// Its name in its JobSet, or its own.
    pub name: &'a str,
    /// Its specification; null for a pod of its own.
    pub spec: &'a Value,
    /// Its pods' labels.
    pub labels: &'a Value,
    /// Its pods'.
    pub pod: &'a Value,
    /// Their container's.
    pub container: &'a Value,
}

impl<'a> Job<'a> {
    /// All jobs, and pods that are on their own.
    pub fn all(objects: &'a [Value]) -> Vec<Self> {
        let mut jobs = Vec::new();
        for object in objects {
            let name = &object["metadata"]["name"];
            match text(&object["kind"]) {
                "JobSet" => {
                    let of_set = list(&object["spec"]["replicatedJobs"]).iter();
                    jobs.extend(of_set.map(|job| Self::of(&job["name"], &job["template"]["spec"])));
                }
                "Job" => jobs.push(Self::of(name, &object["spec"])),
                "Pod" => jobs.push(Self::new(name, &Value::Null, object)),
                _ => {}
            }
        }
        jobs
    }

    fn of(name: &'a Value, spec: &'a Value) -> Self {
        Self::new(name, spec, &spec["template"])
    }

    fn new(name: &'a Value, spec: &'a Value, pod: &'a Value) -> Self {
        let containers = list(&pod["spec"]["containers"]);
        assert_eq!(containers.len(), 1, "containers of {name}");
        Self {
            name: text(name),
            spec,
            labels: &pod["metadata"]["labels"],
            pod: &pod["spec"],
            container: &containers[0],
        }
    }

    /// The job of this name.
    ///
    /// # Panics
    /// If there is none.
    pub fn named(objects: &'a [Value], name: &str) -> Self {
        Self::all(objects).into_iter().find(|job| job.name == name).unwrap_or_else(|| panic!("no job {name}"))
    }

    /// Its container's arguments.
    pub fn args(&self) -> Vec<&'a str> {
        list(&self.container["args"]).iter().map(text).collect()
    }

    /// The value of `--FLAG=VALUE`.
    pub fn flag(&self, flag: &str) -> Option<&'a str> {
        self.args().into_iter().find_map(|arg| arg.strip_prefix(flag)?.strip_prefix('='))
    }

    /// The number of a port.
    pub fn port(&self, name: &str) -> Option<i64> {
        let port = list(&self.container["ports"]).iter().find(|port| port["name"] == name)?;
        port["containerPort"].as_i64()
    }

    /// Whether its pods have these labels.
    pub fn is_selected(&self, labels: &Value) -> bool {
        labels.as_object().is_some_and(|labels| labels.iter().all(|(name, value)| self.labels[name] == *value))
    }

    /// What the job makes of a pod that has failed, by its podFailurePolicy.
    pub fn on_failure(&self, status: i64, condition: Option<&str>) -> &'a str {
        let matches = |rule: &&Value| {
            let codes = &rule["onExitCodes"];
            let named = codes["containerName"] == self.container["name"] && codes["operator"] == "In";
            let condition = |pattern: &Value| condition.is_some_and(|kind| pattern["type"] == kind);
            (named && list(&codes["values"]).contains(&json!(status)))
                || list(&rule["onPodConditions"]).iter().any(condition)
        };
        let rules = list(&self.spec["podFailurePolicy"]["rules"]);
        rules.iter().find(matches).map_or("Count", |rule| text(&rule["action"]))
    }

    /// What the volumes of its pods are: where each is mounted, and what it is.
    pub fn mounts(&self) -> Vec<(&'a str, &'a Value)> {
        let volumes = list(&self.pod["volumes"]);
        let volume = |name: &Value| volumes.iter().find(|volume| volume["name"] == *name).unwrap_or(&Value::Null);
        let mounts = list(&self.container["volumeMounts"]);
        mounts.iter().map(|mount| (text(&mount["mountPath"]), volume(&mount["name"]))).collect()
    }
}

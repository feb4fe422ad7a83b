//! What somebody may do: one table from methods to roles.
//!
//! | role | may |
//! | --- | --- |
//! | `viewer` | look at plants, models and recordings of its tenant, and have something computed |
//! | `driver` | change them, too |
//! | `admin` | do so with those of every tenant, and with models that came with the server; and end the server |
//!
//! Health is for everybody, because balancers have no name; it says whether the server serves, and nothing else.
//! Reflection, and methods that nobody has, take a viewer. So do the metrics and the files of models.

use serde::{Deserialize, Serialize};

use crate::core::connection::Sight;

/// What somebody may do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Look.
    Viewer,
    /// Change what belongs to the own tenant.
    Driver,
    /// Change everything.
    Admin,
}

impl Role {
    /// The one of that name.
    pub(super) fn named(name: &str) -> Option<Self> {
        [Self::Viewer, Self::Driver, Self::Admin].into_iter().find(|role| role.as_str() == name)
    }

    /// Its name in files.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Viewer => "viewer",
            Self::Driver => "driver",
            Self::Admin => "admin",
        }
    }

    /// What it may see and change.
    pub(crate) fn sight(self) -> Sight {
        match self {
            Self::Viewer => Sight::Look,
            Self::Driver => Sight::Own,
            Self::Admin => Sight::All,
        }
    }
}

/// What a request takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Needs {
    /// Nothing: everybody may ask.
    Nothing,
    /// Somebody with this role.
    Role(Role),
}

const HEALTH: &str = "/grpc.health.v1.Health/";
const PACKAGE: &str = "/plantd.v1.";

/// Methods of each service that change nothing.
const LOOKING: [(&str, &[&str]); 6] = [
    ("ChannelService", &["GetChannels", "ListFaults"]),
    (
        "ControlService",
        &[
            "Linearize",
            "LinearizeTrajectory",
            "SolveLqr",
            "SolveTrajectoryLqr",
            "Rollout",
            "LinearizeSecondOrder",
            "EvaluateDynamics",
            "Kinematics",
            "Dynamics",
            "Analyze",
            "OptimizeTrajectory",
            "ProjectReference",
            "SolveKalman",
            "SolveTrajectoryKalman",
        ],
    ),
    ("ModelService", &["ListModels", "GetModel", "ValidateScene", "Settle", "GetDrawing"]),
    (
        "PlantService",
        &[
            "GetPlant",
            "ListPlants",
            "Watch",
            "WatchGains",
            "WatchEvents",
            "Diagnose",
            // Clearing the counts is refused by the method itself.
            "GetTiming",
            "Snapshot",
        ],
    ),
    ("RecordingService", &["ListRecordings", "GetRecording"]),
    ("ServerService", &["GetServer"]),
];

/// Methods of each service that change something.
const DRIVING: [(&str, &[&str]); 4] = [
    ("ChannelService", &["SetChannels", "InjectFault", "ClearFault"]),
    ("ModelService", &["CreateModel", "DeleteModel", "PutModelFile"]),
    (
        "PlantService",
        &[
            "CreatePlant",
            "DeletePlant",
            // It may pause the plant.
            "ExportPlant",
            "Step",
            "StepMany",
            "Drive",
            "Hold",
            "SetInput",
            "Reset",
            "Restore",
            "OpenLink",
            "SetParameters",
            "SetFeedback",
            "ClearFeedback",
            "Run",
            "Pause",
            "SetSafety",
        ],
    ),
    ("RecordingService", &["StartRecording", "StopRecording", "DeleteRecording"]),
];

/// Methods of each service that concern everybody.
const RULING: [(&str, &[&str]); 1] = [("ServerService", &["AdoptPlants", "Drain"])];

/// Whether the table has a method; the path is `/plantd.v1.Service/Method`.
fn role_of(path: &str) -> Option<Role> {
    let (service, method) = path.strip_prefix(PACKAGE)?.split_once('/')?;
    let has = |table: &[(&str, &[&str])]| {
        table.iter().any(|(name, methods)| *name == service && methods.contains(&method))
    };
    let tables =
        [(&LOOKING[..], Role::Viewer), (&DRIVING[..], Role::Driver), (&RULING[..], Role::Admin)];
    tables.into_iter().find(|(table, _)| has(table)).map(|(_, role)| role)
}

/// What a call of a method takes. A method of ours that the table has not takes an administrator.
pub fn needs(path: &str) -> Needs {
    match role_of(path) {
        Some(role) => Needs::Role(role),
        None if path.starts_with(HEALTH) => Needs::Nothing,
        None if is_ours(path) => Needs::Role(Role::Admin),
        None => Needs::Role(Role::Viewer),
    }
}

fn is_ours(path: &str) -> bool {
    let service = path.strip_prefix(PACKAGE).and_then(|rest| rest.split('/').next());
    let services = LOOKING.iter().chain(&DRIVING).chain(&RULING).map(|(name, _)| *name);
    service.is_some_and(|service| services.into_iter().any(|name| name == service))
}

/// Whether a call of this method changes something, or would.
pub fn changes(path: &str) -> bool {
    matches!(needs(path), Needs::Role(role) if role > Role::Viewer)
}

/// Whether a stream of this method is a watcher's.
pub fn watches(path: &str) -> bool {
    let methods = ["Watch", "WatchGains", "WatchEvents"];
    path.strip_prefix("/plantd.v1.PlantService/").is_some_and(|method| methods.contains(&method))
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use plantd_proto::FILE_DESCRIPTOR_SET;
    use prost::Message as _;
    use prost_types::FileDescriptorSet;

    use super::*;

    #[test]
    fn every_method_of_the_contract_has_a_role_and_no_other_has() {
        let set = FileDescriptorSet::decode(FILE_DESCRIPTOR_SET).unwrap();
        let mut contract = BTreeSet::new();
        for file in set.file.iter().filter(|file| file.package() == "plantd.v1") {
            for service in &file.service {
                let path = |method: &str| format!("{PACKAGE}{}/{method}", service.name());
                contract.extend(service.method.iter().map(|method| path(method.name())));
            }
        }
        assert!(contract.len() > 50, "{}", contract.len());
        let missing: Vec<_> = contract.iter().filter(|path| role_of(path).is_none()).collect();
        assert!(missing.is_empty(), "without a role: {missing:?}");
        let mut table = Vec::new();
        for (service, methods) in LOOKING.iter().chain(&DRIVING).chain(&RULING) {
            table.extend(methods.iter().map(|method| format!("{PACKAGE}{service}/{method}")));
        }
        assert_eq!(table.len(), contract.len(), "a method stands in the table twice");
        assert_eq!(table.into_iter().collect::<BTreeSet<_>>(), contract);
    }

    #[test]
    fn what_is_not_in_the_table_is_not_for_everybody() {
        assert_eq!(needs("/plantd.v1.PlantService/Nonsense"), Needs::Role(Role::Admin));
        assert_eq!(needs("/plantd.v1.Connection/Probe"), Needs::Role(Role::Viewer));
        assert_eq!(needs("/grpc.health.v1.Health/Watch"), Needs::Nothing);
        let reflection = "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo";
        assert_eq!(needs(reflection), Needs::Role(Role::Viewer));
        assert_eq!(needs(""), Needs::Role(Role::Viewer));
        assert!(changes("/plantd.v1.PlantService/Step"));
        assert!(!changes("/plantd.v1.PlantService/Watch"));
        assert!(watches("/plantd.v1.PlantService/Watch"));
        assert!(Role::Viewer < Role::Driver && Role::Driver < Role::Admin);
    }
}

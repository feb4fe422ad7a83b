//! `plantd.v1.ModelService`.

use std::collections::HashMap;
use std::sync::Arc;

use plantd_import::{Kind, Report};
use plantd_models::{Model, Problem, SceneError};
use plantd_proto::v1;
use tonic::{Request, Response, Status};

use crate::core::catalog::Entry;
use crate::core::limits::{LimitExceeded, Limits};
use crate::wire::answers::cut_page;
use crate::wire::message::{checks, models, settings};
use crate::wire::models::{drawing, kept, settle};
use crate::wire::shared::hub::Hub;
use crate::wire::status::RpcError;

/// The service.
pub struct ModelService {
    hub: Arc<Hub>,
}

impl ModelService {
    /// The service on a hub.
    pub fn new(hub: Arc<Hub>) -> Self {
        Self { hub }
    }
}

/// Reads and compiles a scene within the limits. A faulty scene is the inner error.
pub(crate) fn compile(
    text: &str,
    format: i32,
    files: &HashMap<String, Vec<u8>>,
    limits: &Limits,
) -> Result<Result<(Model, Option<Report>), SceneError>, RpcError> {
    let read = settings::scene(text, format, files, limits)?;
    let compiled = read.and_then(|(scene, report)| Ok((Model::compile(&scene)?, report)));
    let (model, report) = match compiled {
        Ok(compiled) => compiled,
        Err(error) => return Ok(Err(error)),
    };
    let count = model.dimensions().coordinates();
    LimitExceeded::check("coordinates", limits.coordinates, "coordinates", count)?;
    Ok(Ok((model, report)))
}

fn message(entry: &Entry, with_texts: bool) -> v1::Model {
    models::model(&entry.name, entry.builtin, &entry.model, with_texts)
}

#[tonic::async_trait]
impl v1::model_service_server::ModelService for ModelService {
    async fn list_models(
        &self,
        request: Request<v1::ListModelsRequest>,
    ) -> Result<Response<v1::ListModelsResponse>, Status> {
        let request = request.into_inner();
        let (size, after) = checks::page(request.page_size, &request.page_token)?;
        let (hub, after) = (Arc::clone(&self.hub), after.to_owned());
        let job = move |_: &_| {
            let (entries, has_more) = hub.catalog.page(&after, size)?;
            let mut models: Vec<_> = entries.iter().map(|entry| message(entry, false)).collect();
            let has_more = cut_page(&mut models) || has_more;
            let last = models.last().filter(|_| has_more);
            let next_page_token = last.map(|model| model.name.clone()).unwrap_or_default();
            Ok(v1::ListModelsResponse { models, next_page_token })
        };
        Ok(Response::new(self.hub.workers.run(job).await?))
    }

    async fn get_model(
        &self,
        request: Request<v1::GetModelRequest>,
    ) -> Result<Response<v1::GetModelResponse>, Status> {
        let name = request.into_inner().name;
        let hub = Arc::clone(&self.hub);
        let job = move |_: &_| Ok(message(&hub.catalog.get(&name)?, true));
        let model = Some(self.hub.workers.run(job).await?);
        Ok(Response::new(v1::GetModelResponse { model }))
    }

    async fn create_model(
        &self,
        request: Request<v1::CreateModelRequest>,
    ) -> Result<Response<v1::CreateModelResponse>, Status> {
        let request = request.into_inner();
        if !request.name.is_empty() {
            checks::check_name("name", &request.name)?;
        }
        let hub = Arc::clone(&self.hub);
        let job = move |_: &_| {
            let (model, report) =
                compile(&request.scene, request.format, &request.files, &hub.limits)??;
            let name = match request.name {
                name if name.is_empty() => model.scene().name.clone(),
                name => name,
            };
            checks::check_name("name", &name)?;
            let model = Arc::new(model);
            let entry = match request.replace {
                true => hub.catalog.replace(&name, model)?,
                false => hub.catalog.insert(&name, model)?,
            };
            if let Err(fault) = kept::keep(&hub, &entry) {
                hub.catalog.remove(&name)?;
                return Err(fault);
            }
            let model = Some(message(&entry, true));
            Ok(v1::CreateModelResponse { model, import_report: report.map(import_report) })
        };
        Ok(Response::new(self.hub.workers.run(job).await?))
    }

    async fn validate_scene(
        &self,
        request: Request<v1::ValidateSceneRequest>,
    ) -> Result<Response<v1::ValidateSceneResponse>, Status> {
        let request = request.into_inner();
        let hub = Arc::clone(&self.hub);
        let job = move |_: &_| {
            let v1::ValidateSceneRequest { scene, format, files } = &request;
            Ok(match compile(scene, *format, files, &hub.limits)? {
                Ok((model, report)) => {
                    let model = Some(models::model(&model.scene().name, false, &model, true));
                    let import_report = report.map(import_report);
                    v1::ValidateSceneResponse { problems: Vec::new(), model, import_report }
                }
                Err(error) => {
                    let problems = error.problems.into_iter().map(problem).collect();
                    v1::ValidateSceneResponse { problems, model: None, import_report: None }
                }
            })
        };
        Ok(Response::new(self.hub.workers.run(job).await?))
    }

    async fn delete_model(
        &self,
        request: Request<v1::DeleteModelRequest>,
    ) -> Result<Response<v1::DeleteModelResponse>, Status> {
        let name = request.into_inner().name;
        let hub = Arc::clone(&self.hub);
        let job = move |_: &_| {
            // It may be one that this server has not needed yet.
            let entry = hub.catalog.get(&name)?;
            hub.catalog.remove(&name)?;
            kept::forget(&hub, &entry)
        };
        self.hub.workers.run(job).await?;
        Ok(Response::new(v1::DeleteModelResponse {}))
    }

    async fn settle(
        &self,
        request: Request<v1::SettleRequest>,
    ) -> Result<Response<v1::SettleResponse>, Status> {
        let (hub, request) = (Arc::clone(&self.hub), request.into_inner());
        let job = move |_: &_| settle::settle(&hub, request);
        Ok(Response::new(self.hub.workers.run(job).await?))
    }

    async fn get_drawing(
        &self,
        request: Request<v1::GetDrawingRequest>,
    ) -> Result<Response<v1::GetDrawingResponse>, Status> {
        let (hub, request) = (Arc::clone(&self.hub), request.into_inner());
        let job = move |_: &_| drawing::get(&hub, request);
        Ok(Response::new(self.hub.workers.run(job).await?))
    }

    async fn put_model_file(
        &self,
        request: Request<v1::PutModelFileRequest>,
    ) -> Result<Response<v1::PutModelFileResponse>, Status> {
        let (hub, request) = (Arc::clone(&self.hub), request.into_inner());
        let job = move |_: &_| drawing::put(&hub, request);
        Ok(Response::new(self.hub.workers.run(job).await?))
    }
}

fn import_report(report: Report) -> v1::ImportReport {
    let note = |note: plantd_import::Note| {
        let kind = match note.kind {
            Kind::Contact => v1::ImportKind::Contact,
            Kind::Warning => v1::ImportKind::Warning,
            Kind::Approximated => v1::ImportKind::Approximated,
            Kind::NoEffect => v1::ImportKind::NoEffect,
        };
        v1::ImportNote {
            kind: kind.into(),
            line: note.line,
            column: note.column,
            message: note.message,
            count: note.count as u32,
        }
    };
    let name = |name: plantd_import::Name| v1::ImportName {
        of: name.of.to_owned(),
        from: name.from,
        to: name.to,
    };
    v1::ImportReport {
        notes: report.notes.into_iter().map(note).collect(),
        left_out: report.left_out as u32,
        names: report.names.into_iter().map(name).collect(),
        exact: report.exact.into_iter().map(|(what, n)| (what.to_owned(), n as u32)).collect(),
    }
}

fn problem(problem: Problem) -> v1::SceneProblem {
    v1::SceneProblem { path: problem.path, message: problem.message }
}

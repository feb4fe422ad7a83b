//! Drawings of models and plants, and the files that their meshes are in.

use std::sync::Arc;

use plantd_models::drawing::Drawing;
use plantd_proto::v1;
use v1::get_drawing_request::Of;

use crate::core::catalog::Entry;
use crate::core::files::Files;
use crate::core::limits::LimitExceeded;
use crate::core::session::shared::Session;
use crate::wire::message::drawing;
use crate::wire::shared::hub::Hub;
use crate::wire::status::RpcError;

/// Numbers of a shape.
const SHAPE_NUMBERS: usize = 14;

/// Answers a GetDrawing call.
pub(crate) fn get(
    hub: &Hub,
    request: v1::GetDrawingRequest,
) -> Result<v1::GetDrawingResponse, RpcError> {
    match request.of {
        Some(Of::Plant(id)) => of_plant(hub, &*hub.session(&id)?),
        Some(Of::Model(name)) => {
            let Entry { model, files, .. } = hub.catalog.get(&name)?;
            let shown = Drawing::new(&model);
            check_size(hub, &shown)?;
            Ok(v1::GetDrawingResponse {
                drawing: Some(drawing::drawing(&shown, |file| url(&name, &files, file))),
                generation: 0,
                poses: Some(drawing::poses(&shown.poses())),
            })
        }
        None => Err(RpcError::field("of", "is missing: a plant or a model is needed")),
    }
}

fn of_plant(hub: &Hub, session: &Session) -> Result<v1::GetDrawingResponse, RpcError> {
    let mechanics = session.mechanics();
    let shown = Drawing::new(&mechanics.model);
    check_size(hub, &shown)?;
    Ok(v1::GetDrawingResponse {
        drawing: Some(message_of_plant(hub, session, &shown)),
        generation: mechanics.generation,
        poses: None,
    })
}

/// Refuses a drawing that no client would take.
fn check_size(hub: &Hub, shown: &Drawing) -> Result<(), RpcError> {
    let shapes: usize = shown.frames().map(|frame| frame.shapes.len()).sum();
    let (name, limit) = ("reply_numbers", hub.limits.reply_numbers);
    let numbers = shown.numbers() + SHAPE_NUMBERS * shapes;
    Ok(LimitExceeded::check(name, limit, "numbers in a drawing and its poses", numbers)?)
}

/// The drawing of a plant as a message, with the files of its model.
pub(crate) fn message_of_plant(hub: &Hub, session: &Session, shown: &Drawing) -> v1::Drawing {
    let name = session.model_name();
    let files = files_of(hub, session);
    drawing::drawing(shown, |file| url(name, files.as_ref()?, file))
}

/// The files of a plant's model, unless that is another one by now.
fn files_of(hub: &Hub, session: &Session) -> Option<Arc<Files>> {
    let entry = hub.catalog.get(session.model_name()).ok()?;
    (entry.model.digest() == session.model().digest()).then_some(entry.files)
}

/// Answers a PutModelFile call.
pub(crate) fn put(
    hub: &Hub,
    request: v1::PutModelFileRequest,
) -> Result<v1::PutModelFileResponse, RpcError> {
    let v1::PutModelFileRequest { model, file, data } = request;
    let (path, file) = hub.catalog.put_file(&model, &file, data)?;
    Ok(v1::PutModelFileResponse { url: url_of(&model, &path, file.tag) })
}

/// Where the server has a file of a scene, if it was given to it.
fn url(model: &str, files: &Files, file: &str) -> Option<String> {
    let (path, tag) = files.find(file)?;
    Some(url_of(model, &path, tag))
}

fn url_of(model: &str, path: &str, tag: u64) -> String {
    format!("/models/{model}/files/{path}?v={tag:016x}")
}

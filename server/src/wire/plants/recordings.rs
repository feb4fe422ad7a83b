//! `plantd.v1.RecordingService`.

use std::fs::File;
use std::io::Read as _;
use std::sync::Arc;

use futures::stream;
use plantd_proto::v1;
use tonic::{Request, Response, Status};

use crate::wire::answers::Answers;
use crate::wire::message::checks;
use crate::wire::record::directory::Recordings;
use crate::wire::shared::hub::Hub;
use crate::wire::status::RpcError;

/// Bytes of a recording in one message.
const PIECE_BYTES: u64 = 256 << 10;

/// The service.
pub struct RecordingService {
    hub: Arc<Hub>,
}

impl RecordingService {
    /// The service on a hub.
    pub fn new(hub: Arc<Hub>) -> Self {
        Self { hub }
    }

    /// Does something with the recordings, on a thread that may wait for the disk.
    async fn run<R: Send + 'static>(
        &self,
        job: impl FnOnce(&Hub, &Recordings) -> Result<R, RpcError> + Send + 'static,
    ) -> Result<R, RpcError> {
        let hub = Arc::clone(&self.hub);
        recordings(&self.hub)?.wait(move || job(&hub, recordings(&hub)?)).await
    }
}

fn recordings(hub: &Hub) -> Result<&Recordings, RpcError> {
    hub.recordings.as_ref().ok_or_else(|| {
        let message = "this server has no directory for recordings";
        RpcError::precondition("RECORDINGS_DISABLED", "server", message)
    })
}

/// A file, piece by piece, up to the length that it had.
fn pieces(hub: Arc<Hub>, file: File, length: u64) -> Answers<v1::GetRecordingResponse> {
    Box::pin(stream::try_unfold((hub, file, length), |(hub, file, left)| async move {
        let read = move || {
            let mut data = Vec::new();
            let outcome = (&file).take(left.min(PIECE_BYTES)).read_to_end(&mut data);
            outcome.map_err(|error| RpcError::internal(error.to_string()))?;
            Ok((file, data))
        };
        let (file, data) = recordings(&hub)?.wait(read).await?;
        if data.is_empty() {
            return Ok(None);
        }
        let left = left - data.len() as u64;
        Ok(Some((v1::GetRecordingResponse { data }, (hub, file, left))))
    }))
}

#[tonic::async_trait]
impl v1::recording_service_server::RecordingService for RecordingService {
    type GetRecordingStream = Answers<v1::GetRecordingResponse>;

    async fn start_recording(
        &self,
        request: Request<v1::StartRecordingRequest>,
    ) -> Result<Response<v1::StartRecordingResponse>, Status> {
        let v1::StartRecordingRequest { id, name, checkpoint_interval_s } = request.into_inner();
        let start = move |hub: &Hub, recordings: &Recordings| {
            recordings.start(&hub.session(&id)?, name, checkpoint_interval_s)
        };
        let recording = Some(self.run(start).await?);
        Ok(Response::new(v1::StartRecordingResponse { recording }))
    }

    async fn stop_recording(
        &self,
        request: Request<v1::StopRecordingRequest>,
    ) -> Result<Response<v1::StopRecordingResponse>, Status> {
        let name = request.into_inner().name;
        let recording = Some(self.run(move |_, recordings| recordings.stop(&name)).await?);
        Ok(Response::new(v1::StopRecordingResponse { recording }))
    }

    async fn list_recordings(
        &self,
        request: Request<v1::ListRecordingsRequest>,
    ) -> Result<Response<v1::ListRecordingsResponse>, Status> {
        let request = request.into_inner();
        let (size, after) = checks::page(request.page_size, &request.page_token)?;
        let after = after.to_owned();
        let page = self.run(move |_, recordings| recordings.page(&after, size)).await?;
        let (recordings, has_more) = page;
        let last = recordings.last().filter(|_| has_more);
        let next_page_token = last.map(|recording| recording.name.clone()).unwrap_or_default();
        Ok(Response::new(v1::ListRecordingsResponse { recordings, next_page_token }))
    }

    async fn get_recording(
        &self,
        request: Request<v1::GetRecordingRequest>,
    ) -> Result<Response<Self::GetRecordingStream>, Status> {
        let name = request.into_inner().name;
        let (file, left) = self.run(move |_, recordings| recordings.file(&name)).await?;
        Ok(Response::new(self.hub.until_ending(pieces(Arc::clone(&self.hub), file, left))))
    }

    async fn delete_recording(
        &self,
        request: Request<v1::DeleteRecordingRequest>,
    ) -> Result<Response<v1::DeleteRecordingResponse>, Status> {
        let name = request.into_inner().name;
        self.run(move |_, recordings| recordings.delete(&name)).await?;
        Ok(Response::new(v1::DeleteRecordingResponse {}))
    }
}

//! `PlantService.Hold` and `SetInput`: driving by calls of their own, for browsers.

use std::sync::Arc;

use plantd_proto::link::random_instance;
use plantd_proto::v1;

use crate::core::driver::DriverKind;
use crate::core::plant::error::DriveError;
use crate::core::session::lease::Lease;
use crate::wire::answers::{Answers, Messages};
use crate::wire::shared::hub::Hub;
use crate::wire::status::RpcError;

/// Takes the lease for a Hold call. Blocks for as long as a step takes: call it on a worker.
pub(crate) fn hold(
    hub: &Arc<Hub>,
    request: &v1::HoldRequest,
) -> Result<Answers<v1::HoldResponse>, RpcError> {
    let session = hub.session(&request.id)?;
    let lease = session.acquire(DriverKind::Drive)?;
    let lease_token = format!("{:016x}", random_instance());
    lease.set_name(lease_token.clone());
    let plant = Some(hub.plant_info(&session));
    let opened = Some(v1::HoldResponse { lease_token, plant });
    Ok(Holder { hub: Arc::clone(hub), lease, opened }.into_answers())
}

/// Holds the lease as long as the stream lives.
struct Holder {
    hub: Arc<Hub>,
    lease: Lease,
    /// What the stream says once.
    opened: Option<v1::HoldResponse>,
}

impl Messages for Holder {
    type Message = v1::HoldResponse;

    async fn next(&mut self) -> Result<v1::HoldResponse, RpcError> {
        if let Some(opened) = self.opened.take() {
            return Ok(opened);
        }
        let session = self.lease.session();
        let mut status = session.run_status();
        tokio::select! {
            biased;
            () = self.hub.ending.cancelled() => Err(RpcError::shutting_down()),
            () = session.closed() => Err(RpcError::closed(session)),
            _ = status.wait_for(|_| self.lease.is_revoked()) => {
                Err(RpcError::from_drive(DriveError::Revoked, session))
            }
        }
    }
}

/// Answers a SetInput call.
pub(crate) fn set_input(
    hub: &Hub,
    request: &v1::SetInputRequest,
) -> Result<v1::SetInputResponse, RpcError> {
    let session = hub.session(&request.id)?;
    if !session.runs_by_itself() {
        let why = format!("plant `{}` is in lockstep: Step gives inputs there", session.id());
        return Err(RpcError::precondition("LOCKSTEP", session.id(), why));
    }
    match session.offer_named(&request.lease_token, request.sequence, &request.u) {
        Some(Ok(())) => Ok(v1::SetInputResponse {}),
        Some(Err(error)) => Err(RpcError::from_drive(error, &session)),
        None => {
            let why = format!("the lease of plant `{}` has ended", session.id());
            Err(RpcError::precondition("LEASE_LOST", session.id(), why))
        }
    }
}

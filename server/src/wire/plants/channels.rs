//! `plantd.v1.ChannelService`.

use std::sync::Arc;

use plantd_proto::v1;
use tonic::{Request, Response, Status};

use crate::core::session::shared::Session;
use crate::wire::shared::hub::Hub;
use crate::wire::status::RpcError;

/// The service.
pub struct ChannelService {
    hub: Arc<Hub>,
}

impl ChannelService {
    /// The service on a hub.
    pub fn new(hub: Arc<Hub>) -> Self {
        Self { hub }
    }

    /// Does something with a session, on a worker.
    async fn act<R: Send + 'static>(
        &self,
        id: &str,
        act: impl FnOnce(&Hub, &Session) -> Result<R, RpcError> + Send + 'static,
    ) -> Result<Response<R>, Status> {
        let (hub, session) = (Arc::clone(&self.hub), self.hub.session(id)?);
        let job = move |_: &_| act(&hub, &session);
        Ok(Response::new(self.hub.attendants.run(job).await?))
    }
}

#[tonic::async_trait]
impl v1::channel_service_server::ChannelService for ChannelService {
    async fn set_channels(
        &self,
        request: Request<v1::SetChannelsRequest>,
    ) -> Result<Response<v1::SetChannelsResponse>, Status> {
        let v1::SetChannelsRequest { id, channels } = request.into_inner();
        let set = |hub: &Hub, session: &Session| {
            let (info, y) = session.set_channels(channels.unwrap_or_default(), &hub.limits)?;
            Ok(v1::SetChannelsResponse { info: Some((*info).clone()), y })
        };
        self.act(&id, set).await
    }

    async fn get_channels(
        &self,
        request: Request<v1::GetChannelsRequest>,
    ) -> Result<Response<v1::GetChannelsResponse>, Status> {
        let get = |_: &Hub, session: &Session| {
            let (info, v1::Outputs { y, lost }) = session.channels();
            Ok(v1::GetChannelsResponse { info: Some((*info).clone()), y, lost })
        };
        self.act(&request.into_inner().id, get).await
    }

    async fn inject_fault(
        &self,
        request: Request<v1::InjectFaultRequest>,
    ) -> Result<Response<v1::InjectFaultResponse>, Status> {
        let v1::InjectFaultRequest { id, fault } = request.into_inner();
        let fault = fault.ok_or_else(|| RpcError::field("fault", "is missing"))?;
        let inject = |hub: &Hub, session: &Session| {
            let fault = Some(session.inject_fault(fault, &hub.limits)?);
            Ok(v1::InjectFaultResponse { fault })
        };
        self.act(&id, inject).await
    }

    async fn clear_fault(
        &self,
        request: Request<v1::ClearFaultRequest>,
    ) -> Result<Response<v1::ClearFaultResponse>, Status> {
        let v1::ClearFaultRequest { id, fault_id } = request.into_inner();
        let clear = move |hub: &Hub, session: &Session| {
            let cleared = session.clear_fault(fault_id, &hub.limits)?;
            Ok(v1::ClearFaultResponse { cleared })
        };
        self.act(&id, clear).await
    }

    async fn list_faults(
        &self,
        request: Request<v1::ListFaultsRequest>,
    ) -> Result<Response<v1::ListFaultsResponse>, Status> {
        let list =
            |_: &Hub, session: &Session| Ok(v1::ListFaultsResponse { faults: session.faults() });
        self.act(&request.into_inner().id, list).await
    }
}

//! `plantd.v1.ServerService`.

use std::sync::Arc;
use std::time::Duration;

use plantd_proto::v1;
use tonic::{Request, Response, Status};

use crate::core::identity::{DRAIN_MAX_S, build};
use crate::wire::plants::adopt::adopt_plants;
use crate::wire::shared::hub::Hub;
use crate::wire::status::RpcError;

/// The service.
pub struct ServerService {
    hub: Arc<Hub>,
}

impl ServerService {
    /// The service on a hub.
    pub fn new(hub: Arc<Hub>) -> Self {
        Self { hub }
    }
}

#[tonic::async_trait]
impl v1::server_service_server::ServerService for ServerService {
    async fn get_server(
        &self,
        _: Request<v1::GetServerRequest>,
    ) -> Result<Response<v1::GetServerResponse>, Status> {
        let hub = &self.hub;
        Ok(Response::new(v1::GetServerResponse {
            name: hub.identity.name().to_owned(),
            address: hub.identity.address().to_owned(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            build: build(),
            draining: hub.drain.has_begun(),
            plants: u32::try_from(hub.count()).unwrap_or(u32::MAX),
        }))
    }

    async fn drain(
        &self,
        request: Request<v1::DrainRequest>,
    ) -> Result<Response<v1::DrainResponse>, Status> {
        let limit = request.into_inner().drain_s;
        if limit.is_some_and(|limit_s| !(0.0..=DRAIN_MAX_S).contains(&limit_s)) {
            let problem = format!("must lie between 0 and {DRAIN_MAX_S}");
            return Err(RpcError::field("drain_s", problem).into());
        }
        self.hub.drain.request(limit.map(Duration::from_secs_f64));
        let driven = u32::try_from(self.hub.driven()).unwrap_or(u32::MAX);
        Ok(Response::new(v1::DrainResponse { driven }))
    }

    async fn adopt_plants(
        &self,
        request: Request<v1::AdoptPlantsRequest>,
    ) -> Result<Response<v1::AdoptPlantsResponse>, Status> {
        Ok(Response::new(adopt_plants(&self.hub, request.get_ref()).await?))
    }
}

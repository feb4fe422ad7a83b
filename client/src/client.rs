//! The client: one method per thing that a controller's author wants.

use std::sync::Arc;

use plantd_proto::v1::{
    self, channel_service_client::ChannelServiceClient,
    control_service_client::ControlServiceClient, model_service_client::ModelServiceClient,
    plant_service_client::PlantServiceClient, recording_service_client::RecordingServiceClient,
    server_service_client::ServerServiceClient,
};

use crate::connection::{ConnectOptions, MAX_RECEIVE_BYTES, connect, is_serving};
use crate::credentials::AuthorizedChannel;
use crate::driver::Driver;
use crate::error::{Error, Result};
use crate::follower::Follower;
use crate::stream::Answers;

/// A connection to a server. Clones share it and are cheap.
///
/// Methods whose request has many options take the request message itself; fill in what matters and
/// leave the rest to `..Default::default()`.
#[derive(Clone, Debug)]
pub struct Client {
    address: Arc<str>,
    channel: AuthorizedChannel,
    options: ConnectOptions,
}

impl Client {
    /// Connects to `http://host:port` (or just `host:port`), `https://host:port` or `unix:/path`, where a gRPC
    /// server has to answer.
    ///
    /// # Errors
    /// [`Error::Address`] and [`Error::Connect`] say what is wrong with the address, or what there is.
    pub async fn connect(address: impl AsRef<str>) -> Result<Self> {
        Self::connect_with(address, ConnectOptions::default()).await
    }

    /// Connects with other limits than the default ones.
    pub async fn connect_with(address: impl AsRef<str>, options: ConnectOptions) -> Result<Self> {
        let channel = connect(address.as_ref(), &options).await?;
        Ok(Self { address: address.as_ref().into(), channel, options })
    }

    /// The address of the server.
    pub fn address(&self) -> &str {
        &self.address
    }

    /// Connects to another server as the same user: to where a plant has gone ([`Error::elsewhere`]), or to this one
    /// again after its connection broke.
    ///
    /// # Errors
    /// As of [`Client::connect`]; and [`Error::Address`] where a token that this server got over TLS or a socket
    /// would be sent over a network without TLS.
    pub async fn at(&self, address: impl AsRef<str>) -> Result<Self> {
        let there = address.as_ref();
        let is_here = there == &*self.address;
        let was_hidden = self.address.starts_with("https://") || self.address.starts_with("unix:");
        let is_hidden = there.starts_with("https://") || there.starts_with("unix:");
        if !is_here && self.options.credentials.token.is_some() && was_hidden && !is_hidden {
            let problem = "it is without TLS, and everybody on the way could read the token";
            return Err(Error::Address { address: there.to_owned(), problem });
        }
        let mut options = self.options.clone();
        if !is_here {
            // That was the name of this server.
            options.authority = None;
        }
        Self::connect_with(there, options).await
    }

    /// Whether the server at an address serves, by gRPC's health service, which needs no token: as a whole, where
    /// `service` is empty, or one of its services, such as `plantd.v1.PlantService`, which does not when the server is
    /// about to end.
    ///
    /// # Errors
    /// As of [`Client::connect`].
    pub async fn is_serving(
        address: impl AsRef<str>,
        service: &str,
        options: &ConnectOptions,
    ) -> Result<bool> {
        is_serving(address.as_ref(), service, options).await
    }

    // ---- the generated stubs, for what is not wrapped ----

    /// The generated client of `ModelService`.
    pub fn models(&self) -> ModelServiceClient<AuthorizedChannel> {
        ModelServiceClient::new(self.channel.clone()).max_decoding_message_size(MAX_RECEIVE_BYTES)
    }

    /// The generated client of `PlantService`.
    pub fn plants(&self) -> PlantServiceClient<AuthorizedChannel> {
        PlantServiceClient::new(self.channel.clone()).max_decoding_message_size(MAX_RECEIVE_BYTES)
    }

    /// The generated client of `ControlService`.
    pub fn control(&self) -> ControlServiceClient<AuthorizedChannel> {
        ControlServiceClient::new(self.channel.clone()).max_decoding_message_size(MAX_RECEIVE_BYTES)
    }

    /// The generated client of `ChannelService`.
    pub fn channels(&self) -> ChannelServiceClient<AuthorizedChannel> {
        ChannelServiceClient::new(self.channel.clone()).max_decoding_message_size(MAX_RECEIVE_BYTES)
    }

    /// The generated client of `RecordingService`.
    pub fn recordings(&self) -> RecordingServiceClient<AuthorizedChannel> {
        RecordingServiceClient::new(self.channel.clone())
            .max_decoding_message_size(MAX_RECEIVE_BYTES)
    }

    /// The generated client of `ServerService`.
    pub fn server(&self) -> ServerServiceClient<AuthorizedChannel> {
        ServerServiceClient::new(self.channel.clone()).max_decoding_message_size(MAX_RECEIVE_BYTES)
    }

    /// The channel itself, for services that are not plantd's own (health, reflection).
    pub fn channel(&self) -> AuthorizedChannel {
        self.channel.clone()
    }

    /// A request that the server gives up after the connection's request timeout.
    fn limited<T>(&self, message: T) -> tonic::Request<T> {
        let mut request = tonic::Request::new(message);
        request.set_timeout(self.options.request_timeout);
        request
    }

    /// Waits until a stream is open.
    async fn open<T>(
        &self,
        call: impl Future<Output = Result<tonic::Response<tonic::Streaming<T>>, tonic::Status>>,
    ) -> Result<Answers<T>> {
        Answers::open(self.options.request_timeout, call).await
    }
}

/// The server itself.
impl Client {
    /// Which server this is.
    pub async fn server_info(&self) -> Result<v1::GetServerResponse> {
        let request = self.limited(v1::GetServerRequest {});
        Ok(self.server().get_server(request).await?.into_inner())
    }

    /// Lets the server end: it takes nothing new, and serves on while plants are driven, for `drain_s` at most, its
    /// own time if that is `None`. Returns how many plants are driven.
    pub async fn drain(&self, drain_s: Option<f64>) -> Result<u32> {
        let request = self.limited(v1::DrainRequest { drain_s });
        Ok(self.server().drain(request).await?.into_inner().driven)
    }

    /// Lets the server take the plants over that another one of the same object store has, and does not come back for.
    /// Should that one live after all, nothing of what it does is saved any more.
    pub async fn adopt_plants(&self, from: &str) -> Result<v1::AdoptPlantsResponse> {
        let request = self.limited(v1::AdoptPlantsRequest { from: from.to_owned() });
        Ok(self.server().adopt_plants(request).await?.into_inner())
    }

    /// Everything from which another server makes the same plant.
    pub async fn export_plant(
        &self,
        request: v1::ExportPlantRequest,
    ) -> Result<v1::ExportPlantResponse> {
        Ok(self.plants().export_plant(self.limited(request)).await?.into_inner())
    }

    /// Moves a plant to another server, where it goes on as it was: paused here, made there, and then deleted here.
    /// Who asks for it here is told where it is. A driver in lockstep waits meanwhile, and loses no step if it
    /// [follows](crate::Reconnecting).
    ///
    /// # Errors
    /// The plant stays here, run as it was, when the other server refuses it. [`Error::Rpc`] with reason `MOVED_ON`
    /// when somebody has run it meanwhile: then the one that was made there is deleted again. After any other error of
    /// the last step both may be there, the one here paused.
    pub async fn move_plant(
        &self,
        id: impl Into<String>,
        to: &Client,
        any_build: bool,
    ) -> Result<v1::PlantInfo> {
        let id = id.into();
        let exported =
            self.export_plant(v1::ExportPlantRequest { id: id.clone(), pause: true }).await?;
        let v1::ExportPlantResponse { record, step, run } = exported;
        let request = v1::CreatePlantRequest { record, any_build, ..Default::default() };
        let made = match to.create_plant(request).await {
            Ok(made) => made,
            Err(error) => {
                let run = run.unwrap_or_default();
                if run.running {
                    let (settings, steps) = (run.settings, run.steps_left);
                    let request = v1::RunRequest { id, settings, steps, wait: false };
                    // The first error is the one to tell.
                    let _ = self.run(request).await;
                }
                return Err(error);
            }
        };
        let moved_to =
            if made.address.is_empty() { to.address().to_owned() } else { made.address.clone() };
        let delete = v1::DeletePlantRequest { id: id.clone(), moved_to, step: Some(step) };
        match self.delete_plant_as(delete).await {
            Ok(()) => Ok(made),
            Err(error) if error.reason() == "MOVED_ON" => {
                let _ = to.delete_plant(made.id).await;
                Err(error)
            }
            // It may be deleted here all the same: better two of it than none.
            Err(error) => Err(error),
        }
    }
}

/// Models.
impl Client {
    /// All models, built-in ones first.
    pub async fn list_models(&self) -> Result<Vec<v1::Model>> {
        let mut all = Vec::new();
        let mut page_token = String::new();
        loop {
            let request = v1::ListModelsRequest { page_size: 0, page_token };
            let page = self.models().list_models(self.limited(request)).await?.into_inner();
            all.extend(page.models);
            if page.next_page_token.is_empty() {
                return Ok(all);
            }
            page_token = page.next_page_token;
        }
    }

    /// One model, with its scene and its plan.
    pub async fn get_model(&self, name: impl Into<String>) -> Result<v1::Model> {
        let request = v1::GetModelRequest { name: name.into() };
        let answer = self.models().get_model(self.limited(request)).await?.into_inner();
        answer.model.ok_or(Error::Protocol("an answer without a model"))
    }

    /// Uploads a scene (TOML, JSON), or a robot in URDF, under its own name.
    ///
    /// # Errors
    /// A scene with errors is refused with all of them in [`Error::violations`].
    pub async fn create_model(&self, scene: impl Into<String>) -> Result<v1::Model> {
        let request = v1::CreateModelRequest { scene: scene.into(), ..Default::default() };
        self.create_model_as(request).await
    }

    /// Uploads a scene, under another name or with its notation stated.
    pub async fn create_model_as(&self, request: v1::CreateModelRequest) -> Result<v1::Model> {
        self.import_model(request).await?.model.ok_or(Error::Protocol("an answer without a model"))
    }

    /// Uploads a scene, and tells what became of a robot in another format.
    pub async fn import_model(
        &self,
        request: v1::CreateModelRequest,
    ) -> Result<v1::CreateModelResponse> {
        Ok(self.models().create_model(self.limited(request)).await?.into_inner())
    }

    /// Checks a scene without keeping it; a good one has no problems and comes with its model.
    pub async fn validate_scene(
        &self,
        scene: impl Into<String>,
    ) -> Result<v1::ValidateSceneResponse> {
        let request = v1::ValidateSceneRequest { scene: scene.into(), ..Default::default() };
        self.validate_scene_as(request).await
    }

    /// Checks a scene with its notation stated, or with files of a robot.
    pub async fn validate_scene_as(
        &self,
        request: v1::ValidateSceneRequest,
    ) -> Result<v1::ValidateSceneResponse> {
        Ok(self.models().validate_scene(self.limited(request)).await?.into_inner())
    }

    /// What a viewer draws of a model or a plant.
    pub async fn get_drawing(
        &self,
        request: v1::GetDrawingRequest,
    ) -> Result<v1::GetDrawingResponse> {
        Ok(self.models().get_drawing(self.limited(request)).await?.into_inner())
    }

    /// Gives an uploaded model a file that its visuals name; answers with the path on the server's address where
    /// browsers find it.
    pub async fn put_model_file(&self, request: v1::PutModelFileRequest) -> Result<String> {
        Ok(self.models().put_model_file(self.limited(request)).await?.into_inner().url)
    }

    /// Finds a configuration in which a model rests, or one that satisfies its constraints.
    pub async fn settle(&self, request: v1::SettleRequest) -> Result<v1::SettleResponse> {
        Ok(self.models().settle(self.limited(request)).await?.into_inner())
    }

    /// Forgets an uploaded model; its plants live on.
    pub async fn delete_model(&self, name: impl Into<String>) -> Result<()> {
        let request = v1::DeleteModelRequest { name: name.into() };
        self.models().delete_model(self.limited(request)).await?;
        Ok(())
    }
}

/// Plants.
impl Client {
    /// Creates a plant.
    pub async fn create_plant(&self, request: v1::CreatePlantRequest) -> Result<v1::PlantInfo> {
        let answer = self.plants().create_plant(self.limited(request)).await?.into_inner();
        answer.plant.ok_or(Error::Protocol("an answer without a plant"))
    }

    /// A plant, its state and its energy.
    pub async fn get_plant(&self, id: impl Into<String>) -> Result<v1::GetPlantResponse> {
        let request = v1::GetPlantRequest { id: id.into() };
        Ok(self.plants().get_plant(self.limited(request)).await?.into_inner())
    }

    /// What can be said of a state of a plant or a model: degrees of freedom, energy, momenta, forces.
    pub async fn diagnose(&self, request: v1::DiagnoseRequest) -> Result<v1::DiagnoseResponse> {
        Ok(self.plants().diagnose(self.limited(request)).await?.into_inner())
    }

    /// All plants, by id.
    pub async fn list_plants(&self) -> Result<Vec<v1::PlantInfo>> {
        let mut all = Vec::new();
        let mut page_token = String::new();
        loop {
            let request = v1::ListPlantsRequest { page_size: 0, page_token };
            let page = self.plants().list_plants(self.limited(request)).await?.into_inner();
            all.extend(page.plants);
            if page.next_page_token.is_empty() {
                return Ok(all);
            }
            page_token = page.next_page_token;
        }
    }

    /// Ends a plant; whoever drives or watches it gets `NOT_FOUND`.
    pub async fn delete_plant(&self, id: impl Into<String>) -> Result<()> {
        self.delete_plant_as(v1::DeletePlantRequest { id: id.into(), ..Default::default() }).await
    }

    /// Ends a plant that goes on elsewhere, or only at a step.
    pub async fn delete_plant_as(&self, request: v1::DeletePlantRequest) -> Result<()> {
        self.plants().delete_plant(self.limited(request)).await?;
        Ok(())
    }

    /// Takes one or more steps in one call. To close a loop use [`Client::drive`]: it is faster and
    /// keeps others from stepping in between.
    pub async fn step(&self, request: v1::StepRequest) -> Result<v1::StepResponse> {
        Ok(self.plants().step(self.limited(request)).await?.into_inner())
    }

    /// Steps many plants in one call, each with an input of its own. What could not be stepped says why in its
    /// answer; the others are stepped all the same.
    ///
    /// # Errors
    /// A plant that is not there or given twice, and inputs that do not fit: no plant is stepped then.
    pub async fn step_many(&self, request: v1::StepManyRequest) -> Result<v1::StepManyResponse> {
        Ok(self.plants().step_many(self.limited(request)).await?.into_inner())
    }

    /// Takes the lease of a plant, to step it in lockstep.
    pub async fn drive(&self, id: impl Into<String>) -> Result<Driver> {
        self.drive_as(v1::DriveOpen { id: id.into(), ..Default::default() }).await
    }

    /// Takes the lease of a plant; each answer has the linearization of its step.
    pub async fn drive_linearized(&self, id: impl Into<String>) -> Result<Driver> {
        let open = v1::DriveOpen { id: id.into(), linearization: true, ..Default::default() };
        self.drive_as(open).await
    }

    /// Takes the lease of a plant with all that can be asked for: a lease that outlives a broken
    /// connection (`grace_s`), or one that did (`resume`, with [`Driver::lease_token`]).
    pub async fn drive_as(&self, open: v1::DriveOpen) -> Result<Driver> {
        Driver::open(self.plants(), open, self.options.request_timeout).await
    }

    /// Watches a plant. Latest wins: who reads slowly loses messages, which `dropped` counts. `at_most_hz` of the
    /// request bounds how many come.
    pub async fn watch(&self, request: v1::WatchRequest) -> Result<Answers<v1::WatchResponse>> {
        self.open(self.plants().watch(request)).await
    }

    /// Puts a plant back to step 0, in the state that it was created with.
    pub async fn reset(&self, id: impl Into<String>) -> Result<v1::State> {
        self.reset_to(v1::ResetRequest { id: id.into(), initial: None }).await
    }

    /// Puts a plant back to step 0, in a given state.
    pub async fn reset_to(&self, request: v1::ResetRequest) -> Result<v1::State> {
        let answer = self.plants().reset(self.limited(request)).await?.into_inner();
        answer.state.ok_or(Error::Protocol("an answer without a state"))
    }

    /// Takes a snapshot: a plant restored from it continues bit for bit.
    pub async fn snapshot(&self, id: impl Into<String>) -> Result<Vec<u8>> {
        let request = v1::SnapshotRequest { id: id.into() };
        Ok(self.plants().snapshot(self.limited(request)).await?.into_inner().snapshot)
    }

    /// Restores a snapshot of a plant of the same model, settings, channels and faults, step count included.
    pub async fn restore(&self, id: impl Into<String>, snapshot: Vec<u8>) -> Result<v1::State> {
        self.restore_by(v1::RestoreRequest { id: id.into(), snapshot, state_alone: false }).await
    }

    /// [`restore`](Self::restore), by a request: also the state alone, where channels and faults are others.
    pub async fn restore_by(&self, request: v1::RestoreRequest) -> Result<v1::State> {
        let answer = self.plants().restore(self.limited(request)).await?.into_inner();
        answer.state.ok_or(Error::Protocol("an answer without a state"))
    }

    /// Changes numbers of a plant's scene, or its time step, between two steps; the state stays.
    pub async fn set_parameters(&self, request: v1::SetParametersRequest) -> Result<v1::PlantInfo> {
        let answer = self.plants().set_parameters(self.limited(request)).await?.into_inner();
        answer.plant.ok_or(Error::Protocol("an answer without a plant"))
    }

    /// Runs a plant: by the wall clock, as fast as possible, or in lockstep; with `steps` of 0 for good.
    /// With `wait` it returns when the plant stands still again, however long that takes.
    pub async fn run(&self, request: v1::RunRequest) -> Result<v1::RunInfo> {
        let request =
            if request.wait { tonic::Request::new(request) } else { self.limited(request) };
        let answer = self.plants().run(request).await?.into_inner();
        answer.run.ok_or(Error::Protocol("an answer without what was asked"))
    }

    /// Pauses a plant between two steps; says how it is run, and in which state it stands.
    pub async fn pause(&self, id: impl Into<String>) -> Result<v1::PauseResponse> {
        let request = v1::PauseRequest { id: id.into() };
        Ok(self.plants().pause(self.limited(request)).await?.into_inner())
    }

    /// Takes the lease of a plant until the stream is dropped, for drivers that give inputs by calls of their own; the
    /// one message names the lease for [`Client::set_input`].
    pub async fn hold(&self, id: impl Into<String>) -> Result<Answers<v1::HoldResponse>> {
        let request = v1::HoldRequest { id: id.into() };
        self.open(self.plants().hold(request)).await
    }

    /// Gives a plant that runs by itself an input, under a lease of [`Client::hold`].
    pub async fn set_input(&self, request: v1::SetInputRequest) -> Result<()> {
        self.plants().set_input(self.limited(request)).await?;
        Ok(())
    }

    /// Sets the bounds that protect a plant, in place of those before.
    pub async fn set_safety(&self, request: v1::SetSafetyRequest) -> Result<()> {
        self.plants().set_safety(self.limited(request)).await?;
        Ok(())
    }

    /// What the loop of a plant that runs by itself has counted; `clear` begins anew.
    pub async fn timing(
        &self,
        id: impl Into<String>,
        clear: bool,
    ) -> Result<v1::GetTimingResponse> {
        let request = v1::GetTimingRequest { id: id.into(), clear };
        Ok(self.plants().get_timing(self.limited(request)).await?.into_inner())
    }

    /// What happens to a plant besides its steps, from event `since` on; `None` means from now on.
    pub async fn watch_events(
        &self,
        id: impl Into<String>,
        since: Option<u64>,
    ) -> Result<Answers<v1::WatchEventsResponse>> {
        let request = v1::WatchEventsRequest { id: id.into(), since };
        self.open(self.plants().watch_events(request)).await
    }

    /// Gives a plant a reference with its regulator: for [`Client::watch_gains`], and for the plant's
    /// own loop if the request's mode says so. The gains hold when the answer comes.
    pub async fn set_feedback(&self, request: v1::SetFeedbackRequest) -> Result<v1::FeedbackInfo> {
        let answer = self.plants().set_feedback(self.limited(request)).await?.into_inner();
        answer.feedback.ok_or(Error::Protocol("an answer without a feedback"))
    }

    /// Takes the reference of a plant away; the driver's input acts alone again.
    pub async fn clear_feedback(&self, id: impl Into<String>) -> Result<()> {
        let request = v1::ClearFeedbackRequest { id: id.into() };
        self.plants().clear_feedback(self.limited(request)).await?;
        Ok(())
    }

    /// The gains of a plant's feedback as they are computed: along a trajectory all from the present
    /// step on, ahead of time; about an operating point the one in force and each that replaces it.
    pub async fn watch_gains(
        &self,
        id: impl Into<String>,
    ) -> Result<Answers<v1::WatchGainsResponse>> {
        let request = v1::WatchGainsRequest { id: id.into() };
        self.open(self.plants().watch_gains(request)).await
    }

    /// Follows the gains of a plant's feedback (see [`Client::set_feedback`]), to apply them here.
    ///
    /// # Errors
    /// `FAILED_PRECONDITION` with reason `NO_FEEDBACK` if the plant has none.
    pub async fn follow_gains(&self, id: impl Into<String>) -> Result<Follower> {
        Follower::open(self.plants(), id.into(), self.options.request_timeout).await
    }

    /// Opens the shared-memory link of a plant and says how to reach it.
    pub async fn open_link(&self, id: impl Into<String>) -> Result<v1::OpenLinkResponse> {
        let request = v1::OpenLinkRequest { id: id.into() };
        Ok(self.plants().open_link(self.limited(request)).await?.into_inner())
    }
}

/// Linearizations, analysis, regulators, filters, optimisation and rollouts; nothing here changes a
/// plant.
impl Client {
    /// Linearizes the map of a model at one point.
    pub async fn linearize(&self, request: v1::LinearizeRequest) -> Result<v1::LinearizeResponse> {
        Ok(self.control().linearize(self.limited(request)).await?.into_inner())
    }

    /// Second derivatives of the map of a model at one point: tensors, or contracted with weights.
    pub async fn linearize_second_order(
        &self,
        request: v1::LinearizeSecondOrderRequest,
    ) -> Result<v1::LinearizeSecondOrderResponse> {
        Ok(self.control().linearize_second_order(self.limited(request)).await?.into_inner())
    }

    /// Accelerations and constraint forces of continuous time, with their derivatives.
    pub async fn evaluate_dynamics(
        &self,
        request: v1::EvaluateDynamicsRequest,
    ) -> Result<v1::EvaluateDynamicsResponse> {
        Ok(self.control().evaluate_dynamics(self.limited(request)).await?.into_inner())
    }

    /// Poses, velocities and Jacobians of frames and points, and the centre of mass, at any state.
    pub async fn kinematics(
        &self,
        request: v1::KinematicsRequest,
    ) -> Result<v1::KinematicsResponse> {
        Ok(self.control().kinematics(self.limited(request)).await?.into_inner())
    }

    /// Mass matrix, bias and forces at any state; forward and inverse dynamics, if asked for.
    pub async fn dynamics(&self, request: v1::DynamicsRequest) -> Result<v1::DynamicsResponse> {
        Ok(self.control().dynamics(self.limited(request)).await?.into_inner())
    }

    /// Controllability, observability, modes and frequency response of the linearized map.
    pub async fn analyze(&self, request: v1::AnalyzeRequest) -> Result<v1::AnalyzeResponse> {
        Ok(self.control().analyze(self.limited(request)).await?.into_inner())
    }

    /// Linearizes the map at every step of a trajectory, in order.
    pub async fn linearize_trajectory(
        &self,
        request: v1::LinearizeTrajectoryRequest,
    ) -> Result<Answers<v1::LinearizeTrajectoryResponse>> {
        self.open(self.control().linearize_trajectory(request)).await
    }

    /// Infinite-horizon LQR about an equilibrium.
    pub async fn solve_lqr(&self, request: v1::SolveLqrRequest) -> Result<v1::SolveLqrResponse> {
        Ok(self.control().solve_lqr(self.limited(request)).await?.into_inner())
    }

    /// Time-varying LQR along a trajectory: one gain per step, first step first; the last message
    /// holds only the final reference state.
    pub async fn solve_trajectory_lqr(
        &self,
        request: v1::SolveTrajectoryLqrRequest,
    ) -> Result<Answers<v1::SolveTrajectoryLqrResponse>> {
        self.open(self.control().solve_trajectory_lqr(request)).await
    }

    /// Finds a trajectory of least cost: one message per iteration, the result last. Dropping the
    /// answers ends the search.
    pub async fn optimize_trajectory(
        &self,
        request: v1::OptimizeTrajectoryRequest,
    ) -> Result<Answers<v1::OptimizeTrajectoryResponse>> {
        self.open(self.control().optimize_trajectory(request)).await
    }

    /// Finds a trajectory of least cost and waits for the end: `progress` gets each iteration, the
    /// result comes back.
    pub async fn find_trajectory(
        &self,
        request: v1::OptimizeTrajectoryRequest,
        mut progress: impl FnMut(&v1::OptimizationProgress),
    ) -> Result<v1::OptimizationResult> {
        use v1::optimize_trajectory_response::Response;
        let mut search = self.optimize_trajectory(request).await?;
        while let Some(message) = search.next().await? {
            match message.response {
                Some(Response::Progress(iteration)) => progress(&iteration),
                Some(Response::Result(result)) => return Ok(result),
                None => {}
            }
        }
        Err(Error::StreamClosed)
    }

    /// Compares a configuration trajectory from outside with the motions of the plant and finds one
    /// that follows it: the report first, then one message per step.
    pub async fn project_reference(
        &self,
        request: v1::ProjectReferenceRequest,
    ) -> Result<Answers<v1::ProjectReferenceResponse>> {
        self.open(self.control().project_reference(request)).await
    }

    /// Steady-state Kalman filter about an equilibrium.
    pub async fn solve_kalman(
        &self,
        request: v1::SolveKalmanRequest,
    ) -> Result<v1::SolveKalmanResponse> {
        Ok(self.control().solve_kalman(self.limited(request)).await?.into_inner())
    }

    /// Time-varying Kalman filter along a trajectory: one message per state, the initial one first.
    pub async fn solve_trajectory_kalman(
        &self,
        request: v1::SolveTrajectoryKalmanRequest,
    ) -> Result<Answers<v1::SolveTrajectoryKalmanResponse>> {
        self.open(self.control().solve_trajectory_kalman(request)).await
    }

    /// Runs many simulations at once; answers come in the order in which they end. Each may have failed by
    /// itself: [`RolloutExt::into_states`](crate::RolloutExt::into_states) says so.
    pub async fn rollout(
        &self,
        request: v1::RolloutRequest,
    ) -> Result<Answers<v1::RolloutResponse>> {
        self.open(self.control().rollout(request)).await
    }
}

/// Sensors, actuators and faults.
impl Client {
    /// Declares the channels of a plant, in place of those before; tells what is in force.
    pub async fn set_channels(
        &self,
        plant: impl Into<String>,
        channels: v1::Channels,
    ) -> Result<v1::SetChannelsResponse> {
        let request = v1::SetChannelsRequest { id: plant.into(), channels: Some(channels) };
        Ok(self.channels().set_channels(self.limited(request)).await?.into_inner())
    }

    /// The channels of a plant, with what they deliver.
    pub async fn get_channels(&self, plant: impl Into<String>) -> Result<v1::GetChannelsResponse> {
        let request = v1::GetChannelsRequest { id: plant.into() };
        Ok(self.channels().get_channels(self.limited(request)).await?.into_inner())
    }

    /// Lets something go wrong.
    pub async fn inject_fault(
        &self,
        plant: impl Into<String>,
        fault: v1::FaultSpec,
    ) -> Result<v1::FaultInfo> {
        let request = v1::InjectFaultRequest { id: plant.into(), fault: Some(fault) };
        let answer = self.channels().inject_fault(self.limited(request)).await?.into_inner();
        answer.fault.ok_or(Error::Protocol("an answer without a fault"))
    }

    /// Ends a fault, or with 0 all of them; tells how many.
    pub async fn clear_fault(&self, plant: impl Into<String>, fault: u64) -> Result<u32> {
        let request = v1::ClearFaultRequest { id: plant.into(), fault_id: fault };
        Ok(self.channels().clear_fault(self.limited(request)).await?.into_inner().cleared)
    }

    /// The faults of a plant.
    pub async fn list_faults(&self, plant: impl Into<String>) -> Result<Vec<v1::FaultInfo>> {
        let request = v1::ListFaultsRequest { id: plant.into() };
        Ok(self.channels().list_faults(self.limited(request)).await?.into_inner().faults)
    }
}

/// Recordings.
impl Client {
    /// Starts to record a plant into a file of the server.
    pub async fn start_recording(
        &self,
        request: v1::StartRecordingRequest,
    ) -> Result<v1::Recording> {
        let answer = self.recordings().start_recording(self.limited(request)).await?.into_inner();
        answer.recording.ok_or(Error::Protocol("an answer without a recording"))
    }

    /// Ends a recording; its file is complete when the answer comes.
    pub async fn stop_recording(&self, name: impl Into<String>) -> Result<v1::Recording> {
        let request = v1::StopRecordingRequest { name: name.into() };
        let answer = self.recordings().stop_recording(self.limited(request)).await?.into_inner();
        answer.recording.ok_or(Error::Protocol("an answer without a recording"))
    }

    /// All recordings of the server.
    pub async fn list_recordings(&self) -> Result<Vec<v1::Recording>> {
        let mut all = Vec::new();
        let mut page_token = String::new();
        loop {
            let request = v1::ListRecordingsRequest { page_size: 0, page_token };
            let page = self.recordings().list_recordings(self.limited(request)).await?.into_inner();
            all.extend(page.recordings);
            if page.next_page_token.is_empty() {
                return Ok(all);
            }
            page_token = page.next_page_token;
        }
    }

    /// The bytes of a recording's file, piece by piece.
    pub async fn get_recording(
        &self,
        name: impl Into<String>,
    ) -> Result<Answers<v1::GetRecordingResponse>> {
        let request = v1::GetRecordingRequest { name: name.into() };
        self.open(self.recordings().get_recording(request)).await
    }

    /// Deletes a recording that has ended.
    pub async fn delete_recording(&self, name: impl Into<String>) -> Result<()> {
        let request = v1::DeleteRecordingRequest { name: name.into() };
        self.recordings().delete_recording(self.limited(request)).await?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn calls_may_be_made_on_other_threads() {
        fn assert_send<T: Send>(_: impl FnOnce(&'static Client) -> T) {}
        assert_send(|client| client.list_models());
        assert_send(|client| client.drive("a"));
        assert_send(|client| client.watch_gains("a"));
        assert_send(|client| client.follow_gains("a"));
    }
}

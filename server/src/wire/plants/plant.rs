//! `plantd.v1.PlantService`.

use std::sync::Arc;
use std::time::Instant;

use plantd_models::{Dimensions, Initial};
use plantd_proto::v1;
use tonic::{Request, Response, Status, Streaming};

use crate::core::driver::DriverKind;
use crate::core::inputs::{Inputs, hold_input};
use crate::core::limits::LimitExceeded;
use crate::core::plant::core::Core;
use crate::core::plant::view::PlantSnapshot;
use crate::core::publish::frame::Frame;
use crate::core::session::lease::Lease;
use crate::core::session::shared::Session;
use crate::core::workers::pool::Abandoned;
use crate::core::workers::queue::Admission;
use crate::wire::answers::{Answers, cut_page};
use crate::wire::message::plant_info::{INLINE_INSTRUCTIONS_MAX, INLINE_TIME_MAX};
use crate::wire::message::report::report_message;
use crate::wire::message::start::{self, Start};
use crate::wire::message::{checks, settings, states};
use crate::wire::plants::drive::DriveStream;
use crate::wire::plants::state::claim;
use crate::wire::plants::{feedback, hold, run, step_many, travel, watch};
use crate::wire::shared::hub::Hub;
use crate::wire::status::RpcError;

/// The service.
pub struct PlantService {
    hub: Arc<Hub>,
}

impl PlantService {
    /// The service on a hub.
    pub fn new(hub: Arc<Hub>) -> Self {
        Self { hub }
    }

    async fn create(&self, request: v1::CreatePlantRequest) -> Result<Arc<Session>, RpcError> {
        if !request.record.is_empty() {
            return travel::import(&self.hub, request).await;
        }
        let v1::CreatePlantRequest { id, model, settings, initial, open_link, expires_s, .. } =
            request;
        let expires = settings::expires(expires_s)?;
        if !id.is_empty() {
            checks::check_name("id", &id)?;
        }
        self.hub.check_new_plant(&id)?;
        let mut settings = settings.unwrap_or_default();
        let tolerance = std::mem::take(&mut settings.tolerance);
        let is_chosen = tolerance != 0.0;
        for (name, given) in [("order", settings.order), ("substeps", settings.substeps)] {
            if is_chosen && given != 0 {
                return Err(RpcError::field(
                    format!("settings.{name}"),
                    "is chosen by `tolerance`",
                ));
            }
        }
        let hub = Arc::clone(&self.hub);
        let job = move |abandoned: &Abandoned| {
            let entry = hub.catalog.get(&model)?;
            let settings = settings::settings(Some(settings), &entry.model, &hub.limits)?;
            let start = start::start(initial, &entry.model, &hub.limits)?;
            let (model, limits) = (&entry.model, &hub.limits);
            let (plant, accuracy) = if is_chosen {
                let chosen =
                    start::accurate_plant(model, settings, &start, tolerance, limits, abandoned)?;
                (chosen.0, Some(chosen.1))
            } else {
                (start::plant(model, settings, &start, "initial")?, None)
            };
            hub.insert(id, entry.name, plant, accuracy, expires)
        };
        let workers = if is_chosen { &self.hub.workers } else { &self.hub.attendants };
        let session = workers.run(job).await?;
        if open_link && let Err(fault) = self.hub.open_link(Arc::clone(&session)).await {
            self.hub.delete(session.id()).await?;
            return Err(fault);
        }
        claim(&self.hub, &session, false).await?;
        tracing::info!(plant = session.id(), model = session.model_name(), "plant created");
        Ok(session)
    }

    async fn step(&self, request: v1::StepRequest) -> Result<v1::StepResponse, RpcError> {
        let session = self.hub.session(&request.id)?;
        let dimensions = session.model().dimensions();
        let inputs = Inputs::new("u", request.u, dimensions.input())?;
        let plan = StepPlan {
            steps: inputs.count().saturating_add(request.hold as usize),
            inputs,
            impulses: impulses(request.impulses, dimensions)?,
            all_states: request.all_states,
        };
        if plan.steps == 0 {
            return Err(RpcError::field("u", "and `hold` are both empty: no step is asked for"));
        }
        if plan.impulses.count() > plan.steps {
            return Err(RpcError::field("impulses", "has more rows than there are steps"));
        }
        let limits = &self.hub.limits;
        LimitExceeded::check("steps_per_call", limits.steps_per_call, "steps", plan.steps)?;
        if plan.all_states {
            let numbers = states::state_numbers(dimensions);
            let numbers = plan.steps.saturating_mul(numbers);
            let (name, limit) = ("reply_numbers", limits.reply_numbers);
            LimitExceeded::check(name, limit, "numbers in all states", numbers)?;
        }
        let lease = session.acquire(DriverKind::Step)?;
        let settings = lease.look(|core| *core.plant().settings());
        let settings = settings.map_err(|error| RpcError::from_drive(error, &session))?;
        let instructions = settings::period_instructions(session.step_instructions(), &settings);
        let mut steps = Steps::new(plan, lease)?;
        if instructions <= INLINE_INSTRUCTIONS_MAX {
            let began = Instant::now();
            let is_over = || Ok(began.elapsed() >= INLINE_TIME_MAX);
            if let Some(response) = steps.go_on(is_over)? {
                return Ok(response);
            }
        }
        let part = move |abandoned: &Abandoned| steps.go_on(|| Ok(abandoned.part_is_over()?));
        self.hub.steppers.in_parts(Admission::Bounded, part).await
    }

    /// Puts a plant into another state under a lease of its own.
    async fn put(
        &self,
        id: &str,
        change: impl FnOnce(&mut Lease) -> Result<Frame, RpcError> + Send + 'static,
    ) -> Result<v1::State, RpcError> {
        let mut lease = self.hub.session(id)?.acquire(DriverKind::Step)?;
        let job = move |_: &_| {
            let frame = change(&mut lease)?;
            Ok(states::shown(&frame.published()))
        };
        self.hub.attendants.run(job).await
    }
}

fn impulses(given: Option<v1::Matrix>, dimensions: Dimensions) -> Result<Inputs, RpcError> {
    if given.iter().flat_map(|given| &given.data).any(|impulse| !impulse.is_finite()) {
        return Err(RpcError::field("impulses.data", "must be finite"));
    }
    Inputs::new("impulses", given, dimensions.dynamic)
}

/// The steps of one Step call.
struct StepPlan {
    inputs: Inputs,
    impulses: Inputs,
    steps: usize,
    all_states: bool,
}

/// A plan of steps on its way.
struct Steps {
    plan: StepPlan,
    lease: Lease,
    taken: usize,
    /// The input of the steps after those that have one of their own.
    held: Vec<f64>,
    response: v1::StepResponse,
}

impl Steps {
    fn new(plan: StepPlan, lease: Lease) -> Result<Self, RpcError> {
        let held = match plan.inputs.last() {
            Some(last) => last.to_vec(),
            None => lease
                .look(|core| hold_input(core.plant()))
                .map_err(|error| RpcError::from_drive(error, lease.session()))?,
        };
        let mut response = v1::StepResponse::default();
        response.states.reserve(if plan.all_states { plan.steps } else { 1 });
        Ok(Self { plan, lease, taken: 0, held, response })
    }

    /// Takes steps until all are taken, or `is_over` after one of them.
    fn go_on(
        &mut self,
        is_over: impl Fn() -> Result<bool, RpcError>,
    ) -> Result<Option<v1::StepResponse>, RpcError> {
        loop {
            self.step()?;
            if self.taken == self.plan.steps {
                return Ok(Some(std::mem::take(&mut self.response)));
            }
            if is_over()? {
                return Ok(None);
            }
        }
    }

    fn step(&mut self) -> Result<(), RpcError> {
        let Self { plan, lease, taken, held, response } = self;
        let k = *taken;
        let u = if k < plan.inputs.count() { plan.inputs.get(k) } else { held };
        let is_last = k + 1 == plan.steps;
        let look = |core: &mut Core| {
            if plan.all_states || is_last {
                response.states.push(states::shown(&core.published()));
            }
            if is_last {
                response.report = Some(report_message(core.report()));
                response.clocks = Some(states::clocks(core.plant().time_s(), 0));
                response.u = core.applied_input().map(<[f64]>::to_vec).unwrap_or_default();
                response.outputs = states::core_outputs(core);
            }
        };
        let impulse = if k < plan.impulses.count() { plan.impulses.get(k) } else { &[] };
        let stepped = lease.step_pushed_and(u, impulse, None, look);
        stepped
            .map_err(|error| RpcError::from_drive(error, lease.session()).with("steps_taken", k))?;
        *taken += 1;
        Ok(())
    }
}

#[tonic::async_trait]
impl v1::plant_service_server::PlantService for PlantService {
    type DriveStream = DriveStream;
    type HoldStream = Answers<v1::HoldResponse>;
    type WatchStream = Answers<v1::WatchResponse>;
    type WatchGainsStream = Answers<v1::WatchGainsResponse>;
    type WatchEventsStream = Answers<v1::WatchEventsResponse>;

    async fn run(
        &self,
        request: Request<v1::RunRequest>,
    ) -> Result<Response<v1::RunResponse>, Status> {
        Ok(Response::new(run::run_and_wait(&self.hub, request.into_inner()).await?))
    }

    async fn pause(
        &self,
        request: Request<v1::PauseRequest>,
    ) -> Result<Response<v1::PauseResponse>, Status> {
        let (hub, id) = (Arc::clone(&self.hub), request.into_inner().id);
        let job = move |_: &_| run::pause(&hub, &id);
        Ok(Response::new(self.hub.attendants.run(job).await?))
    }

    async fn set_safety(
        &self,
        request: Request<v1::SetSafetyRequest>,
    ) -> Result<Response<v1::SetSafetyResponse>, Status> {
        let (hub, request) = (Arc::clone(&self.hub), request.into_inner());
        let job = move |_: &_| run::set_safety(&hub, request);
        Ok(Response::new(self.hub.attendants.run(job).await?))
    }

    async fn get_timing(
        &self,
        request: Request<v1::GetTimingRequest>,
    ) -> Result<Response<v1::GetTimingResponse>, Status> {
        Ok(Response::new(run::get_timing(&self.hub, &request.into_inner())?))
    }

    async fn watch_events(
        &self,
        request: Request<v1::WatchEventsRequest>,
    ) -> Result<Response<Self::WatchEventsStream>, Status> {
        Ok(Response::new(run::watch_events(&self.hub, &request.into_inner())?))
    }

    async fn create_plant(
        &self,
        request: Request<v1::CreatePlantRequest>,
    ) -> Result<Response<v1::CreatePlantResponse>, Status> {
        let session = self.create(request.into_inner()).await?;
        let hub = Arc::clone(&self.hub);
        let job = move |_: &_| Ok(hub.plant_info(&session));
        let plant = Some(self.hub.attendants.resume(job).await?);
        Ok(Response::new(v1::CreatePlantResponse { plant }))
    }

    async fn get_plant(
        &self,
        request: Request<v1::GetPlantRequest>,
    ) -> Result<Response<v1::GetPlantResponse>, Status> {
        let (hub, session) = (Arc::clone(&self.hub), self.hub.session(&request.into_inner().id)?);
        let job = move |_: &_| {
            let (view, mut copy) = session.view_and_copy();
            let energy = Some(states::energy(copy.energy()));
            Ok(v1::GetPlantResponse { plant: Some(hub.info(&session, view)), energy })
        };
        Ok(Response::new(self.hub.attendants.run(job).await?))
    }

    async fn list_plants(
        &self,
        request: Request<v1::ListPlantsRequest>,
    ) -> Result<Response<v1::ListPlantsResponse>, Status> {
        let request = request.into_inner();
        let (size, after) = checks::page(request.page_size, &request.page_token)?;
        let (sessions, has_more) = self.hub.page(after, size);
        let hub = Arc::clone(&self.hub);
        let job = move |_: &_| {
            let mut plants: Vec<_> =
                sessions.iter().map(|session| hub.plant_info(session)).collect();
            let has_more = cut_page(&mut plants) || has_more;
            let last = plants.last().filter(|_| has_more);
            let next_page_token = last.map(|plant| plant.id.clone()).unwrap_or_default();
            Ok(v1::ListPlantsResponse { plants, next_page_token })
        };
        Ok(Response::new(self.hub.attendants.run(job).await?))
    }

    async fn delete_plant(
        &self,
        request: Request<v1::DeletePlantRequest>,
    ) -> Result<Response<v1::DeletePlantResponse>, Status> {
        let v1::DeletePlantRequest { id, moved_to, step } = request.into_inner();
        travel::delete(&self.hub, &id, moved_to, step).await?;
        tracing::info!(plant = id, "plant deleted");
        Ok(Response::new(v1::DeletePlantResponse {}))
    }

    async fn export_plant(
        &self,
        request: Request<v1::ExportPlantRequest>,
    ) -> Result<Response<v1::ExportPlantResponse>, Status> {
        let (hub, request) = (Arc::clone(&self.hub), request.into_inner());
        let job = move |_: &_| travel::export(&hub, &request);
        Ok(Response::new(self.hub.attendants.run(job).await?))
    }

    async fn step(
        &self,
        request: Request<v1::StepRequest>,
    ) -> Result<Response<v1::StepResponse>, Status> {
        Ok(Response::new(self.step(request.into_inner()).await?))
    }

    async fn step_many(
        &self,
        request: Request<v1::StepManyRequest>,
    ) -> Result<Response<v1::StepManyResponse>, Status> {
        Ok(Response::new(step_many::step_many(&self.hub, request.into_inner()).await?))
    }

    async fn drive(
        &self,
        request: Request<Streaming<v1::DriveRequest>>,
    ) -> Result<Response<Self::DriveStream>, Status> {
        Ok(Response::new(DriveStream::new(Arc::clone(&self.hub), request.into_inner())))
    }

    async fn hold(
        &self,
        request: Request<v1::HoldRequest>,
    ) -> Result<Response<Self::HoldStream>, Status> {
        let (hub, request) = (Arc::clone(&self.hub), request.into_inner());
        let job = move |_: &_| hold::hold(&hub, &request);
        Ok(Response::new(self.hub.attendants.run(job).await?))
    }

    async fn set_input(
        &self,
        request: Request<v1::SetInputRequest>,
    ) -> Result<Response<v1::SetInputResponse>, Status> {
        Ok(Response::new(hold::set_input(&self.hub, &request.into_inner())?))
    }

    async fn watch(
        &self,
        request: Request<v1::WatchRequest>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        let (hub, request) = (Arc::clone(&self.hub), request.into_inner());
        let job = move |_: &_| watch::stream(&hub, request);
        Ok(Response::new(self.hub.attendants.run(job).await?))
    }

    async fn reset(
        &self,
        request: Request<v1::ResetRequest>,
    ) -> Result<Response<v1::ResetResponse>, Status> {
        let v1::ResetRequest { id, initial } = request.into_inner();
        let (hub, model) = (Arc::clone(&self.hub), Arc::clone(self.hub.session(&id)?.model()));
        let change = move |lease: &mut Lease| match initial {
            None => lease.reset().map_err(|error| RpcError::from_initial(error, "initial")),
            Some(initial) => match start::start(Some(initial), &model, &hub.limits)? {
                Start::Snapshot(snapshot) => Ok(lease.restore(*snapshot)?),
                Start::Initial(initial) => initialize(lease, &initial),
            },
        };
        let state = Some(self.put(&id, change).await?);
        Ok(Response::new(v1::ResetResponse { state }))
    }

    async fn snapshot(
        &self,
        request: Request<v1::SnapshotRequest>,
    ) -> Result<Response<v1::SnapshotResponse>, Status> {
        let session = self.hub.session(&request.into_inner().id)?;
        let job = move |_: &_| Ok(session.snapshot().to_bytes());
        let snapshot = self.hub.attendants.run(job).await?;
        Ok(Response::new(v1::SnapshotResponse { snapshot }))
    }

    async fn restore(
        &self,
        request: Request<v1::RestoreRequest>,
    ) -> Result<Response<v1::RestoreResponse>, Status> {
        let v1::RestoreRequest { id, snapshot, state_alone } = request.into_inner();
        let change = move |lease: &mut Lease| {
            let mut snapshot = PlantSnapshot::from_bytes(&snapshot)?;
            if state_alone {
                snapshot.channels = None;
            }
            Ok(lease.restore(snapshot)?)
        };
        let state = Some(self.put(&id, change).await?);
        Ok(Response::new(v1::RestoreResponse { state }))
    }

    async fn set_parameters(
        &self,
        request: Request<v1::SetParametersRequest>,
    ) -> Result<Response<v1::SetParametersResponse>, Status> {
        Ok(Response::new(feedback::set_parameters(&self.hub, request.into_inner()).await?))
    }

    async fn set_feedback(
        &self,
        request: Request<v1::SetFeedbackRequest>,
    ) -> Result<Response<v1::SetFeedbackResponse>, Status> {
        Ok(Response::new(feedback::set_feedback(&self.hub, request.into_inner()).await?))
    }

    async fn clear_feedback(
        &self,
        request: Request<v1::ClearFeedbackRequest>,
    ) -> Result<Response<v1::ClearFeedbackResponse>, Status> {
        let (hub, id) = (Arc::clone(&self.hub), request.into_inner().id);
        let job = move |_: &_| feedback::clear_feedback(&hub, &id);
        Ok(Response::new(self.hub.attendants.run(job).await?))
    }

    async fn watch_gains(
        &self,
        request: Request<v1::WatchGainsRequest>,
    ) -> Result<Response<Self::WatchGainsStream>, Status> {
        let (hub, id) = (Arc::clone(&self.hub), request.into_inner().id);
        let job = move |_: &_| feedback::watch_gains(&hub, &id);
        Ok(Response::new(self.hub.attendants.run(job).await?))
    }

    async fn diagnose(
        &self,
        request: Request<v1::DiagnoseRequest>,
    ) -> Result<Response<v1::DiagnoseResponse>, Status> {
        let (hub, request) = (Arc::clone(&self.hub), request.into_inner());
        let job = move |_: &_| {
            let v1::DiagnoseRequest { id, model, initial } = request;
            let mut plant = if model.is_empty() {
                hub.session(&id)?.copy_plant()
            } else if id.is_empty() {
                let model = hub.catalog.get(&model)?.model;
                let start = start::start(initial, &model, &hub.limits)?;
                let settings = settings::settings(None, &model, &hub.limits)?;
                start::plant(&model, settings, &start, "initial")?
            } else {
                return Err(RpcError::field("model", "is given together with `id`"));
            };
            let step = plant.step_index();
            Ok(states::diagnostics(step, plant.diagnose()))
        };
        Ok(Response::new(self.hub.attendants.run(job).await?))
    }

    async fn open_link(
        &self,
        request: Request<v1::OpenLinkRequest>,
    ) -> Result<Response<v1::OpenLinkResponse>, Status> {
        let session = self.hub.session(&request.into_inner().id)?;
        let info = self.hub.open_link(session).await?;
        Ok(Response::new(v1::OpenLinkResponse {
            service: info.service,
            root_path: info.root.to_string_lossy().into_owned(),
            layout_version: info.layout_version,
        }))
    }
}

fn initialize(lease: &mut Lease, initial: &Initial) -> Result<Frame, RpcError> {
    lease.initialize(initial).map_err(|error| RpcError::from_initial(error, "initial"))
}

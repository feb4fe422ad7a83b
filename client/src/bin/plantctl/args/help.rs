//! Longer help texts.

pub(crate) const EXAMPLES: &str = "\
Examples:
  plantctl list                                     models and plants of the server
  plantctl create pendulum --id p1 --at upright     a plant at a named operating point
  plantctl step p1 --u 0.1 --count 100              100 steps with the input 0.1
  plantctl watch p1 --fields state,energy --json    one JSON object per step
  plantctl linearize cart-pole --at upright         A and B of x[k+1] = f(x[k], u[k])
  plantctl lqr cart-pole --at upright --q 100,1,1,1 --r 0.1
  plantctl analyze cart-pole --at hanging --outputs theta --frequencies 0.1,0.5,1
  plantctl optimize swing-up.toml --save best.json  one line per iteration, then the result
  plantctl kalman cart-pole --at upright --outputs x,theta --measurement 1e-4 --process 1e-6
  plantctl set-parameter p1 'frames[pole].body.mass=1.2'
  plantctl feedback set p1 --at upright --q 100,1 --r 1 --mode replace
  plantctl channels set p1 sensors.toml             sensors and actuators of a plant
  plantctl fault inject p1 input=tau stuck=true start_s=2 duration_s=0.5
  plantctl settle four-bar --guess crank=0.3 --toml  an operating point to paste into the scene
  plantctl validate arm.toml                        all errors of a scene, with their paths
  plantctl record start p1 --name trial             then `record stop trial`, `record get trial`
  plantctl replay trial.mcap                        the same steps again, compared bit for bit
  plantctl export trial.mcap --csv trial.csv
  plantctl test scenarios --junit junit.xml         scenarios with their expectations
  plantctl --address unix:/run/plantd/plantd.sock list plants";

pub(crate) const EXIT_CODES: &str = "\
Data goes to standard output, messages to standard error.

Exit codes:
  0  done; where things already were as asked for, a message says so
  1  refused by the server, or failed; `validate`: the scene has errors; `replay`: a step differs;
     `run --wait`: something else has stopped the plant
  2  wrong usage
  3  no server at the address
  4  `optimize`: the search stopped before it converged; what it found is printed, and saved if asked for";

pub(crate) const PROBLEM: &str = "\
The problem, here the swing-up of a pendulum; only model, steps and cost must be there:

  model = \"pendulum\"
  steps = 100
  time_step_s = 0.1                 # the scene's if not given
  paper = false                     # all forces at the start of a step
  order = 2                         # of accuracy
  substeps = 1                      # steps in a time step
  halvings = 8                      # how often a time step that cannot be solved is halved
  fast = false                      # stop the solver at eleven digits

  [initial]                         # the scene's initial configuration if not given
  q = [0.0]                         # with p and v; or an operating point: at = \"hanging\"

  [cost]                            # 1/2 dx' q dx + dx' s du + 1/2 du' r du
  q = [1000.0, 1.0]                 # a diagonal, or a matrix as a list of rows
  r = [50.0]
  q_final = [1000.0, 1.0]           # q if not given
  projected_momentum = false        # weigh it in place of the state's own
  x = [[0.0, 0.0]]                  # desired states, one row per step; the last one holds on
  u = [[0.0]]                       # desired inputs, the same way; zero if not given
  changes = [{ step = 50, x = [3.141592653589793, 0.0] }]   # other desired states from there on

  [guess]
  u = [[0.0]]                       # inputs, the last row holds on; if not given no forces, and
                                    # prescribed coordinates stay
  [bounds]
  state = { theta = [-4.0, 4.0] }   # inf and -inf for no bound
  input = { tau = [-5.0, 5.0] }
  final_state = { theta = [3.14, 3.15] }

  [free_initial]
  entries = [\"theta\"]
  weight = [1.0, 1.0]

  [options]                         # names and defaults of OptimizationOptions in the contract
  first_method = \"quasi-newton\"
  first_iterations = 4
  max_iterations = 50
  projection = { q = [1.0, 1.0], r = [1.0] }";

pub(crate) const CHANNELS: &str = "\
The file, in the field names of the contract, TOML or JSON; here for a pendulum:

  seed = 7                          # of all noise and chance

  [[outputs]]
  name = \"encoder\"                  # source -> sampled -> + bias + noise -> quantised -> limited
  coordinate = \"theta\"              #   -> lost at times -> late
  sample_period_s = 0.1
  latency_s = 0.2
  noise = 0.001                     # standard deviation
  quantum = 0.0015
  drop_out = 0.01                   # probability

  [[outputs]]
  name = \"tip\"                      # others: velocity, acceleration, orientation,
  position = { frame = \"rod\", at = [0.0, -1.0, 0.0] }     # constraint_force, input, energy

  [[inputs]]
  input = \"tau\"                     # sampled and held -> late -> dead band -> limited
  delay_s = 0.1                     #   -> rate limited -> quantised
  min = -5.0
  max = 5.0
  max_rate = 50.0

Times become whole steps; the answer says which.";

pub(crate) const RUN: &str = "\
Examples:
  plantctl run arm --pace paced                     by the wall clock; its driver's latest input acts
  plantctl run arm --pace paced --speed 0.1         ten times slower
  plantctl run arm --pace paced --timeout 0.05 --action ramp --ramp 0.2 --safe 0,0
  plantctl pause arm
  plantctl run arm -n 1 --wait                      a single step, and wait until it is taken";

pub(crate) const GUARD: &str = "\
Quantities are coordinates, v(coordinate), force(constraint) and energy; actions are freeze (if none is
given), reset and disconnect.
Examples:
  plantctl guard cart 'x<2' 'x>-2' 'energy<50:reset'
  plantctl guard cart";

pub(crate) const FAULTS: &str = "\
Examples:
  plantctl fault inject p1 input=tau stuck=true
  plantctl fault inject p1 input=tau offset.value=0.3 start_s=2 duration_s=0.5
  plantctl fault inject p1 output=encoder noise.deviation=0.05 chance.window_s=1 chance.probability=0.2
  plantctl fault inject p1 output=encoder loss.probability=0.1
  plantctl fault inject p1 push.point.frame=rod 'push.force=[5, 0, 0]' start_step=100 duration_s=0.1
  plantctl fault inject p1 'parameters.parameters=[{path=\"gravity[1]\", value=-1.6}]' start_s=3
  plantctl fault list p1
  plantctl fault clear p1 3";

// A robot of thirty joints, in MJCF: waist 3, head 1, arms 7 each, legs 6 each.

const joint = (name, axis) => `<joint name="${name}" axis="${axis}" damping="0.5"/>`;
const limb = (from, to, size) => `<geom type="capsule" fromto="${from} ${to}" size="${size}"/>`;

const arm = (side, y) => `
  <body name="${side}_upper_arm" pos="0 ${y} 0.4">
    ${joint(`${side}_shoulder_pitch`, "0 1 0")}${joint(`${side}_shoulder_roll`, "1 0 0")}${joint(`${side}_shoulder_yaw`, "0 0 1")}
    ${limb("0 0 0", "0 0 -0.26", 0.04)}
    <body name="${side}_forearm" pos="0 0 -0.3">
      ${joint(`${side}_elbow`, "0 1 0")}${joint(`${side}_wrist_yaw`, "0 0 1")}
      ${limb("0 0 0", "0 0 -0.2", 0.035)}
      <body name="${side}_hand" pos="0 0 -0.25">
        ${joint(`${side}_wrist_roll`, "1 0 0")}${joint(`${side}_wrist_pitch`, "0 1 0")}
        <geom type="box" pos="0 0 -0.07" size="0.02 0.045 0.07"/>
      </body>
    </body>
  </body>`;

const leg = (side, y) => `
  <body name="${side}_thigh" pos="0 ${y} -0.08">
    ${joint(`${side}_hip_yaw`, "0 0 1")}${joint(`${side}_hip_roll`, "1 0 0")}${joint(`${side}_hip_pitch`, "0 1 0")}
    ${limb("0 0 -0.03", "0 0 -0.37", 0.06)}
    <body name="${side}_shin" pos="0 0 -0.4">
      ${joint(`${side}_knee`, "0 1 0")}
      ${limb("0 0 -0.03", "0 0 -0.35", 0.045)}
      <body name="${side}_foot" pos="0 0 -0.4">
        ${joint(`${side}_ankle_pitch`, "0 1 0")}${joint(`${side}_ankle_roll`, "1 0 0")}
        <geom type="box" pos="0.03 0 -0.03" size="0.11 0.05 0.03"/>
      </body>
    </body>
  </body>`;

/** The robot, hung up by its pelvis. */
export const humanoid = `
<mujoco model="humanoid">
  <option timestep="0.005"/>
  <default><joint armature="0.02"/><geom density="1000"/></default>
  <worldbody>
    <body name="torso" pos="0 0 1">
      ${joint("waist_yaw", "0 0 1")}${joint("waist_roll", "1 0 0")}${joint("waist_pitch", "0 1 0")}
      <geom type="box" pos="0 0 0.25" size="0.09 0.16 0.2"/>
      <body name="head" pos="0 0 0.5">${joint("neck", "0 0 1")}<geom type="sphere" pos="0 0 0.1" size="0.1"/></body>
      ${arm("left", 0.22)}${arm("right", -0.22)}${leg("left", 0.1)}${leg("right", -0.1)}
    </body>
  </worldbody>
</mujoco>`;

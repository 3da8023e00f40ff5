// npm canopen as the master of the rig, and as its WSP unit (node 32).
//
// The master walks the drives to OPERATION ENABLED, turns a roller, reads speeds by PDO and drives
// the valves until the train has stopped. It simulates the inertia of the vehicle.
//
// Usage: node master.js HOST PORT EDS_FOLDER; the port is the socketcand port of the bench. The last
// line of the output is the result as JSON.
'use strict';
const fs = require('fs');
const net = require('net');
const path = require('path');
const { Device, Eds, DataType } = require('canopen');

const [host, port, folder] = process.argv.slice(2);

// node numbers
const DRIVES = [1, 2, 3, 4];
const SPEED_UNIT = 16;
const BRAKE_IO = 17;
const UNIT = 32;

const CYCLE_MS = 10;
const HEARTBEAT_MS = 50;
const SDO_TIMEOUT_MS = 3000;
const LONGEST_RUN_MS = 60000;
const CYCLIC_VELOCITY = 9; // mode of operation

// steps to OPERATION ENABLED: a controlword, and the pattern of the statusword that answers it
const STATE_MASK = 0x6f;
const STEPS = [[6, 0x21], [7, 0x23], [15, 0x27]];

// the data sheet of the rig
const ROLLER_M = 1.0;
const WHEEL_M = 0.445;
const MASS_KG = 43000;
const INERTIA_KGM2 = 1200; // of a roller
const RATED_NM = 15000;
// units of one count on the bus
const WHEEL_SPEED_RAD_S = 0.01;
const ROLLER_SPEED_COUNTS = 1e4; // in a rad/s
const TORQUE_FRACTION = 1e-3;

// turning a roller: roller 1 runs faster than the others for some cycles, once the rig moves
const SPEED_UP = 1.05;
const TURN_CYCLES = 60;
const ROLLING_MRAD = 4000; // angle of a roller that shows that the rig moves
const BRAKED_MBAR = 100; // cylinder pressure
// without this many readings of a turning wheel the train has not run yet
const READINGS_OF_A_RUN = 200;

const device = new Device({ id: UNIT });
const eds = device.eds;
// what has happened, for the test
const result = { enabled: [], turned: 0, cycles: 0, vents: 0, speeds_read: 0, stopped: false, eds: 0 };

// --- objects that PDOs carry
let nextIndex = 0x2000;
function object(name, dataType) {
  return eds.addEntry(nextIndex++, { parameterName: name, dataType });
}
const I8 = DataType.INTEGER8;
const I16 = DataType.INTEGER16;
const I32 = DataType.INTEGER32;
const U8 = DataType.UNSIGNED8;
const U16 = DataType.UNSIGNED16;
const wheels = DRIVES.map((axle) => object(`wheel ${axle}`, I16));
const pressures = DRIVES.map((axle) => object(`pressure ${axle}`, I16));
const magnets = object('magnets', U8);
const drives = DRIVES.map((id) => ({
  id,
  statusword: object('statusword', U16),
  display: object('display', I8),
  torque: object('torque', I16),
  speed: object('speed', I32),
  position: object('position', I32),
  controlword: object('controlword', U16),
  mode: object('mode', I8),
  target: object('torque target', I16),
  velocity: object('velocity target', I32),
}));

function mapPdos() {
  eds.addReceivePdo({ cobId: 0x180 + SPEED_UNIT, dataObjects: wheels });
  eds.addReceivePdo({ cobId: 0x180 + BRAKE_IO, dataObjects: pressures });
  // Type 1 is sent after a SYNC that the device receives. This device sends SYNC itself, so it also
  // writes these PDOs itself.
  eds.addTransmitPdo({ cobId: 0x200 + BRAKE_IO, transmissionType: 1, dataObjects: [magnets] });
  for (const drive of drives) {
    eds.addReceivePdo({
      cobId: 0x180 + drive.id,
      dataObjects: [drive.statusword, drive.display, drive.torque],
    });
    eds.addReceivePdo({ cobId: 0x280 + drive.id, dataObjects: [drive.speed, drive.position] });
    eds.addTransmitPdo({
      cobId: 0x200 + drive.id,
      transmissionType: 1,
      dataObjects: [drive.controlword, drive.mode, drive.target],
    });
    eds.addTransmitPdo({
      cobId: 0x300 + drive.id,
      transmissionType: 1,
      dataObjects: [drive.velocity],
    });
  }
}

// --- the bus: socketcand's raw mode
function connect() {
  const socket = net.connect(Number(port), host);
  socket.setNoDelay(true);
  device.addListener('message', ({ id, data }) => {
    const bytes = data ? [...data] : [];
    const words = bytes.map((byte) => byte.toString(16)).join(' ');
    socket.write(`< send ${id.toString(16)} ${bytes.length} ${words} >`);
  });

  function handle(words) {
    if (words[0] === 'hi') {
      socket.write('< open rig0 >');
    } else if (words[0] === 'ok' && !socket.opened) {
      socket.opened = true;
      socket.write('< rawmode >');
    } else if (words[0] === 'ok') {
      socket.emit('raw');
    } else if (words[0] === 'frame') {
      const data = Buffer.from(words.slice(3).join(''), 'hex');
      device.receive({ id: parseInt(words[1], 16), data, len: data.length });
    }
  }

  let text = '';
  socket.on('data', (portion) => {
    text += portion.toString('ascii');
    let end = text.indexOf('>');
    while (end >= 0) {
      handle(text.slice(text.indexOf('<') + 1, end).trim().split(/\s+/));
      text = text.slice(end + 1);
      end = text.indexOf('>');
    }
  });
  // the bench closes the bus when the train has stood for a while
  socket.on('close', finish);
  socket.on('error', finish);
  return new Promise((resolve) => socket.once('raw', resolve));
}

// --- the sequence
const sleep = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
const write = (id, index, data, dataType) =>
  device.sdo.download({ deviceId: id, index, data, dataType, timeout: SDO_TIMEOUT_MS });
const read = (id, index, dataType) =>
  device.sdo.upload({ deviceId: id, index, dataType, timeout: SDO_TIMEOUT_MS });

// walks a drive to OPERATION ENABLED
async function enable(drive) {
  await write(drive.id, 0x6060, CYCLIC_VELOCITY, I8);
  drive.mode.value = CYCLIC_VELOCITY;
  for (const [controlword, pattern] of STEPS) {
    await write(drive.id, 0x6040, controlword, U16);
    const statusword = await read(drive.id, 0x6041, U16);
    if ((statusword & STATE_MASK) !== pattern) {
      throw new Error(
        `drive ${drive.id}: statusword ${statusword.toString(16)}h after controlword ${controlword}`);
    }
    drive.controlword.value = controlword;
  }
  result.enabled.push(drive.id);
}

let speed_m_s = 0; // of the simulated vehicle
let before_ms = 0;
let turning = 0; // cycles in which roller 1 has been turned
let factor = 1; // by which roller 1 runs faster than the others

const sum = (values) => values.reduce((total, value) => total + value, 0);
const wheelSpeed_m_s = (wheel) => wheel.value * WHEEL_SPEED_RAD_S * WHEEL_M;

// Advances the speed of the vehicle to now. While the train brakes, the torques of the drives act on
// the vehicle's inertia. Before, the vehicle has the speed of its wheels.
function simulate() {
  const now_ms = performance.now();
  const elapsed_s = (now_ms - before_ms) / 1000;
  before_ms = now_ms;
  if (pressures.every((pressure) => pressure.value < BRAKED_MBAR)) {
    // The drives follow the targets of the first turn. From then on the wheels would only show these
    // targets, so the speed before the turn remains.
    if (!turning) speed_m_s = sum(wheels.slice(1).map(wheelSpeed_m_s)) / 3;
    return;
  }
  const torque_Nm = sum(drives.map((drive) => drive.torque.value)) * TORQUE_FRACTION * RATED_NM;
  // the rollers have a part of the vehicle's inertia
  const simulated_kg = MASS_KG - 4 * INERTIA_KGM2 / ROLLER_M ** 2;
  speed_m_s = Math.max(0, speed_m_s - torque_Nm / ROLLER_M / simulated_kg * elapsed_s);
}

// A simple slide protection: it vents the brake of a wheel that slides much, and holds that of a
// wheel that slides.
function protect() {
  let bits = 0;
  wheels.forEach((wheel, at) => {
    const sliding_m_s = speed_m_s - wheelSpeed_m_s(wheel);
    if (speed_m_s > 1 && sliding_m_s > 0.5 + 0.15 * speed_m_s) {
      bits |= 0b11 << 2 * at;
      result.vents++;
    } else if (speed_m_s > 1 && sliding_m_s > 0.3 + 0.05 * speed_m_s) {
      bits |= 0b01 << 2 * at;
    }
  });
  magnets.value = bits;
}

function sendTargets() {
  for (const drive of drives) {
    const target_m_s = drive.id === 1 ? speed_m_s * factor : speed_m_s;
    drive.velocity.value = Math.round(target_m_s / ROLLER_M * ROLLER_SPEED_COUNTS);
    if (result.enabled.includes(drive.id)) {
      device.pdo.write(0x200 + drive.id);
      device.pdo.write(0x300 + drive.id);
    }
  }
}

// decides how fast roller 1 turns in the next cycle
function turnRoller() {
  const [first, second] = drives;
  // the rig may have waited for its unit
  const rigMoves = second.position.value > ROLLING_MRAD;
  if (!rigMoves || result.enabled.length !== DRIVES.length || turning >= TURN_CYCLES) return;
  turning++;
  factor = turning < TURN_CYCLES ? SPEED_UP : 1;
  result.turned = Math.max(result.turned, first.speed.value / Math.max(second.speed.value, 1));
}

// notes whether a wheel turns, and whether the train has run and has stopped
function noteStandstill(aWheelTurns) {
  if (aWheelTurns) result.speeds_read++;
  const hasRun = result.speeds_read > READINGS_OF_A_RUN;
  const aRollerTurns = drives.some((drive) => drive.speed.value !== 0);
  result.stopped = hasRun && !aWheelTurns && !aRollerTurns;
}

function cycle() {
  result.cycles++;
  simulate();
  protect();
  sendTargets();
  device.pdo.write(0x200 + BRAKE_IO);
  device.sync.write();
  turnRoller();
  noteStandstill(wheels.some((wheel) => wheel.value !== 0));
}

let finished = false;
function finish() {
  if (finished) return;
  finished = true;
  console.log(JSON.stringify(result));
  process.exit(0);
}

async function main() {
  for (const file of fs.readdirSync(folder).filter((name) => name.endsWith('.eds'))) {
    if (Eds.fromFile(path.join(folder, file)).getEntry(0x1000)) result.eds++;
  }
  eds.setHeartbeatProducerTime(HEARTBEAT_MS);
  eds.setSyncCobId(0x80);
  eds.setSyncGenerationEnable(true);
  for (const id of [...DRIVES, SPEED_UNIT, BRAKE_IO]) {
    eds.addSdoClientParameter(id, 0x600 + id, 0x580 + id);
  }
  mapPdos();
  await connect();
  device.start();
  device.nmt.startNode(); // this device
  device.nmt.startNode(0); // all nodes
  const timer = setInterval(cycle, CYCLE_MS);
  await sleep(200);
  for (const drive of drives) await enable(drive);
  setTimeout(() => {
    clearInterval(timer);
    finish();
  }, LONGEST_RUN_MS);
}

main().catch((error) => {
  console.error(error);
  process.exit(1);
});

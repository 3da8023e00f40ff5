// npm canopen as the master of the rig, and its WSP unit (node 32): walks the drives to OPERATION
// ENABLED, turns a roller, reads speeds by PDO and drives the valves until the train stands.
// usage: node master.js HOST PORT EDS_FOLDER; the bus is the hub's socketcand port
'use strict';
const fs = require('fs');
const net = require('net');
const path = require('path');
const { Device, Eds, DataType } = require('canopen');

const [host, port, folder] = process.argv.slice(2);
const DRIVES = [1, 2, 3, 4], SPEED_UNIT = 16, BRAKE_IO = 17, UNIT = 32;
const CYCLE_MS = 10, CSV = 9, OPERATION_ENABLED = 0x27;
// the rig's data sheet: rollers, wheels, vehicle
const ROLLER_M = 1.0, WHEEL_M = 0.445, MASS_KG = 43000, INERTIA_KGM2 = 1200, RATED_NM = 15000;
const SPEED_UP = 1.05, TURN_CYCLES = 60, ROLLING_MRAD = 4000;

const device = new Device({ id: UNIT });
const eds = device.eds;
const told = { enabled: [], turned: 0, cycles: 0, vents: 0, speeds_read: 0, stopped: false, eds: 0 };

// --- objects that PDOs carry
let next = 0x2000;
function object(name, dataType) {
  return eds.addEntry(next++, { parameterName: name, dataType });
}
const I16 = DataType.INTEGER16, U16 = DataType.UNSIGNED16, U8 = DataType.UNSIGNED8;
const I8 = DataType.INTEGER8, I32 = DataType.INTEGER32;
const wheels = [1, 2, 3, 4].map((axle) => object(`wheel ${axle}`, I16));
const pressures = [1, 2, 3, 4].map((axle) => object(`pressure ${axle}`, I16));
const magnets = object('magnets', U8);
const drives = DRIVES.map((id) => ({
  id,
  statusword: object('statusword', U16), display: object('display', I8), torque: object('torque', I16),
  speed: object('speed', I32), position: object('position', I32),
  controlword: object('controlword', U16), mode: object('mode', I8), target: object('torque target', I16),
  velocity: object('velocity target', I32),
}));

function mapPdos() {
  eds.addReceivePdo({ cobId: 0x180 + SPEED_UNIT, dataObjects: wheels });
  eds.addReceivePdo({ cobId: 0x180 + BRAKE_IO, dataObjects: pressures });
  // type 1: on a SYNC that is received, so never by itself; written beside each SYNC
  eds.addTransmitPdo({ cobId: 0x200 + BRAKE_IO, transmissionType: 1, dataObjects: [magnets] });
  for (const one of drives) {
    eds.addReceivePdo({ cobId: 0x180 + one.id, dataObjects: [one.statusword, one.display, one.torque] });
    eds.addReceivePdo({ cobId: 0x280 + one.id, dataObjects: [one.speed, one.position] });
    eds.addTransmitPdo({ cobId: 0x200 + one.id, transmissionType: 1,
      dataObjects: [one.controlword, one.mode, one.target] });
    eds.addTransmitPdo({ cobId: 0x300 + one.id, transmissionType: 1, dataObjects: [one.velocity] });
  }
}

// --- the bus: socketcand's raw mode
function connect() {
  const socket = net.connect(Number(port), host);
  socket.setNoDelay(true);
  device.addListener('message', ({ id, data }) => {
    const bytes = data ? [...data] : [];
    socket.write(`< send ${id.toString(16)} ${bytes.length} ${bytes.map((b) => b.toString(16)).join(' ')} >`);
  });
  let text = '';
  socket.on('data', (portion) => {
    text += portion.toString('ascii');
    for (let end; (end = text.indexOf('>')) >= 0; text = text.slice(end + 1)) {
      const words = text.slice(text.indexOf('<') + 1, end).trim().split(/\s+/);
      if (words[0] === 'hi') socket.write('< open rig0 >');
      else if (words[0] === 'ok' && !socket.opened) { socket.opened = true; socket.write('< rawmode >'); }
      else if (words[0] === 'ok') socket.emit('raw');
      else if (words[0] === 'frame') {
        const data = Buffer.from(words.slice(3).join(''), 'hex');
        device.receive({ id: parseInt(words[1], 16), data, len: data.length });
      }
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
  device.sdo.download({ deviceId: id, index, data, dataType, timeout: 3000 });
const read = (id, index, dataType) => device.sdo.upload({ deviceId: id, index, dataType, timeout: 3000 });

async function enable(one) {
  await write(one.id, 0x6060, CSV, I8);
  one.mode.value = CSV;
  for (const [word, mask, wanted] of [[6, 0x6f, 0x21], [7, 0x6f, 0x23], [15, 0x6f, OPERATION_ENABLED]]) {
    await write(one.id, 0x6040, word, U16);
    const state = await read(one.id, 0x6041, U16);
    if ((state & mask) !== wanted) throw new Error(`drive ${one.id}: ${state.toString(16)}h after ${word}`);
    one.controlword.value = word;
  }
  told.enabled.push(one.id);
}

let speed_m_s = 0, factor = 1, turning = 0, before_ms = 0;

// inertia of the vehicle at the rollers, which the master simulates from the drives' torques
function simulate() {
  const now_ms = performance.now(), elapsed_s = (now_ms - before_ms) / 1000;
  before_ms = now_ms;
  if (pressures.every((one) => one.value < 100)) {
    // once the rollers are held they tell what they were told: the speed of before counts
    if (!turning) speed_m_s = wheels.slice(1).reduce((sum, one) => sum + one.value, 0) / 3 * 0.01 * WHEEL_M;
    return;
  }
  const torque_Nm = drives.reduce((sum, one) => sum + one.torque.value, 0) * 1e-3 * RATED_NM;
  const rolling_kg = MASS_KG - 4 * INERTIA_KGM2 / ROLLER_M ** 2;
  speed_m_s = Math.max(0, speed_m_s - torque_Nm / ROLLER_M / rolling_kg * elapsed_s);
}

// a simple slide protection: vent a wheel that slides much, hold one that slides
function protect() {
  let bits = 0;
  wheels.forEach((one, at) => {
    const sliding_m_s = speed_m_s - one.value * 0.01 * WHEEL_M;
    if (speed_m_s > 1 && sliding_m_s > 0.5 + 0.15 * speed_m_s) { bits |= 3 << 2 * at; told.vents++; }
    else if (speed_m_s > 1 && sliding_m_s > 0.3 + 0.05 * speed_m_s) bits |= 1 << 2 * at;
  });
  magnets.value = bits;
}

function cycle() {
  told.cycles++;
  if (wheels.some((one) => one.value)) told.speeds_read++;
  simulate();
  protect();
  for (const one of drives) {
    one.velocity.value = Math.round(speed_m_s * (one.id === 1 ? factor : 1) / ROLLER_M * 1e4);
    if (told.enabled.includes(one.id)) { device.pdo.write(0x200 + one.id); device.pdo.write(0x300 + one.id); }
  }
  device.pdo.write(0x200 + BRAKE_IO);
  device.sync.write();
  // the rig may have waited for its unit: it rolls when its rollers' angles grow
  const rolls = drives[1].position.value > ROLLING_MRAD;
  if (rolls && told.enabled.length === DRIVES.length && turning < TURN_CYCLES) {
    factor = ++turning < TURN_CYCLES ? SPEED_UP : 1;
    told.turned = Math.max(told.turned, drives[0].speed.value / Math.max(drives[1].speed.value, 1));
  }
  told.stopped = told.speeds_read > 200 && wheels.every((one) => one.value === 0)
    && drives.every((one) => one.speed.value === 0);
}

let finished = false;
function finish() {
  if (finished) return;
  finished = true;
  console.log(JSON.stringify(told));
  process.exit(0);
}

async function main() {
  for (const file of fs.readdirSync(folder).filter((name) => name.endsWith('.eds'))) {
    if (Eds.fromFile(path.join(folder, file)).getEntry(0x1000)) told.eds++;
  }
  eds.setHeartbeatProducerTime(50);
  eds.setSyncCobId(0x80);
  eds.setSyncGenerationEnable(true);
  for (const id of [...DRIVES, SPEED_UNIT, BRAKE_IO]) eds.addSdoClientParameter(id, 0x600 + id, 0x580 + id);
  mapPdos();
  await connect();
  device.start();
  device.nmt.startNode();   // itself
  device.nmt.startNode(0);  // and everybody
  const timer = setInterval(cycle, CYCLE_MS);
  await sleep(200);
  for (const one of drives) await enable(one);
  setTimeout(() => { clearInterval(timer); finish(); }, 60000);
}

main().catch((error) => { console.error(error); process.exit(1); });

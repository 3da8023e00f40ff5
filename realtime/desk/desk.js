// Draws what the bench reports: the plots, the lanes of the dump valves, the figures and the turning wheels.
//
// The page requests new rows only after it has drawn the last ones. A browser that is suspended
// requests nothing, and the server stores nothing for it.
//
// `live.py` calls `begin` for each vehicle that the desk shows, and `show`. A row is an array with one
// number a column; a missing number is null.

// pauses between two requests for rows
const PAUSE_MS = 100;
const PAUSE_WHOLE_RUN_MS = 1000;
const PAUSE_AFTER_ERROR_MS = 1000;

// the status with which a desk that was started again refuses the pages of the former one
const FORBIDDEN = "403";

// the turning wheels: a browser that was suspended does not catch up, and a wheel turns at a
// twentieth of its real speed, because a faster one seems to stand still or to turn backwards
const LONGEST_FRAME_S = 0.1;
const SLOW_MOTION = 20;

// the lanes of the dump valves, in pixels
const LANES_LEFT = 48;
const LANES_RIGHT = 14;
const LANE_GAP = 3;

// the names of fault marks: rows, and their height
const MARK_ROWS = 5;
const MARK_ROW_PX = 14;

// the height of a lane by the state of its valve: fill, hold, vent
const LANE_SHARES = [0.25, 0.6, 1];

// the picture of the vehicle, in units of its view box: a coach with two bogies is 700 wide
const LEAST_WIDTH = 700;
const FIRST_BOGIE_X = 90;
const BOGIE_PITCH = 200;
const TOP = 28;
// the size of its text, which is larger where a wide picture is drawn smaller
const WIDE = 880;
const TEXT_SIZE = 14;
const HEIGHT = 122;
const HEIGHT_OF_MOTOR_TEXT = 16;
const HALF_WHEELBASE = 50;
const WHEEL_Y = 76;
// the magnets of a bogie are between its wheels, so much lower when they are on the rail
const MAGNET_Y = 84;
const MAGNET_DROP = 12;
const ON_RAIL = 0.999;
// a motor without a demand has no text below this torque
const LEAST_TORQUE_Nm = 50;
const SPOKES_DEG = [0, 60, 120];

// Returns a number with some decimals, or a dash where there is no number.
function numberText(value, decimals) {
  if (value === null || value === undefined) return "–";
  return value.toFixed(decimals);
}

// Returns a speed in km/h, or null where there is none.
function kilometresPerHour(speed_m_s) {
  if (speed_m_s === null || speed_m_s === undefined) return null;
  return 3.6 * speed_m_s;
}

// Returns the width of the picture of a vehicle with these bogies.
function pictureWidth(bogies) {
  return Math.max(LEAST_WIDTH, 2 * FIRST_BOGIE_X + BOGIE_PITCH * (bogies - 1));
}

// Returns the places of the bogies in the picture.
function bogiePlaces(bogies) {
  const width = pictureWidth(bogies);
  if (bogies === 1) return [width / 2];
  const gap = (width - 2 * FIRST_BOGIE_X) / (bogies - 1);
  return Array.from({ length: bogies }, (_, index) => FIRST_BOGIE_X + gap * index);
}

// Returns a round number that is not less.
function roundUp(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  const step = [1, 1.25, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10].find((candidate) => candidate * power >= value * (1 - 1e-9));
  // without the rounding of the product, which a label would show in full
  return Number((step * power).toPrecision(3));
}

// Returns the vertical range of a plot: the points of all lines except limits, zero, and at least `least`.
function verticalRange(series, least) {
  let low = 0;
  let high = least;
  for (const one of series) {
    if (one.limit) continue;
    for (const [, value] of one.data) {
      if (value === null) continue;
      low = Math.min(low, value);
      high = Math.max(high, value);
    }
  }
  // noise below zero shows no negative half
  const min = low > -least / 2 ? 0 : -roundUp(-low);
  return { min, max: high > least ? roundUp(high) : least };
}

// Returns the colours of text and lines, which desk.css has for a light and for a dark system.
function inks() {
  const style = getComputedStyle(document.body);
  const ink = (name) => style.getPropertyValue(`--${name}`).trim();
  return { text: ink("text"), soft: ink("soft"), grid: ink("grid"), bad: ink("bad"), back: ink("back") };
}

window.desk = {
  ink: null, // the colours of `inks`
  scheme: "", // "light" or "dark", as the system
  settings: null, // what `live.py` gives to `begin`: columns, plots, colours and limits
  columnIndex: {}, // the place of each column in a row
  bench: "", // the bench that the rows belong to
  next: 0, // number of the first point that the page has not received yet
  rows: [], // the rows that are drawn
  newest: null, // the newest row
  marks: [], // faults: [time in s, name, whether it begins]
  braked: null, // m since the first brake demand, or null without a demand
  heldSpeed: null, // m/s while the rig is held, otherwise null
  whole: false, // whether the whole run is drawn, or only its last seconds
  axle: 0, // the axle that is drawn; 0: all
  axles: 0, // number of axles of the vehicle
  angles: [], // of the drawn wheels, rad
  lastFrame: 0, // time of the last picture of the wheels, ms

  // Draws a vehicle from now on. `settings` has the keys that `live.py` writes.
  begin(settings) {
    const isFirst = this.settings === null;
    this.settings = settings;
    this.axles = settings.axles.length;
    this.angles = Array(this.axles).fill(0);
    this.columnIndex = {};
    settings.columns.forEach((name, index) => {
      this.columnIndex[name] = index;
    });
    this.bench = "";
    this.next = 0;
    this.rows = [];
    this.newest = null;
    this.marks = [];
    // the page has new switches, too
    this.axle = 0;
    this.whole = false;
    if (!isFirst) return;
    this.ink = inks();
    this.update();
    requestAnimationFrame((now) => this.turnWheels(now));
  },

  // Gives the text and the lines of all charts the colours of the system, as soon as they are there.
  colourCharts() {
    const scheme = document.body.classList.contains("body--dark") ? "dark" : "light";
    if (this.ink === null || scheme !== this.scheme) this.ink = inks();
    this.scheme = scheme;
    for (const place of document.querySelectorAll(".desk-chart")) {
      const chart = getElement(Number(place.id.slice(1)))?.chart;
      if (!chart || chart.isDisposed() || chart.deskScheme === scheme) continue;
      chart.deskScheme = scheme;
      const { text, soft, grid } = this.ink;
      const axis = { axisLabel: { color: soft }, axisLine: { lineStyle: { color: soft } } };
      axis.splitLine = { lineStyle: { color: grid } };
      const legend = { textStyle: { color: text }, pageTextStyle: { color: text } };
      legend.pageIconColor = text;
      legend.pageIconInactiveColor = soft;
      chart.setOption({ title: { textStyle: { color: text } }, legend, xAxis: axis, yAxis: axis });
    }
  },

  // Chooses the axle to draw (0: all), and whether the whole run is drawn.
  show(axle, whole) {
    this.axle = axle;
    if (whole !== this.whole) {
      // the points of the whole run are thinned: they do not continue those of the last seconds
      this.rows = [];
      this.next = 0;
      this.whole = whole;
    }
  },

  // Requests rows and draws them, then does so again after a pause.
  async update() {
    let pause = PAUSE_MS;
    try {
      const visible = !document.hidden && document.getElementById("desk-time");
      if (visible) {
        await this.fetchRows();
        const begin = performance.now();
        if (this.placeVehicle()) this.draw();
        const drawing = performance.now() - begin;
        // a slow browser spends at most a third of its time on drawing
        pause = this.whole ? PAUSE_WHOLE_RUN_MS : Math.max(PAUSE_MS - drawing, 2 * drawing);
      }
    } catch (error) {
      pause = PAUSE_AFTER_ERROR_MS;
      const place = document.getElementById("desk-time");
      const refused = error.message === FORBIDDEN;
      const text = refused ? "this desk has another address now" : "the desk does not answer";
      if (place) place.textContent = text;
    }
    setTimeout(() => this.update(), pause);
  },

  // Requests the rows after the last received point. Throws an error if the desk refuses.
  async fetchRows() {
    const query = `bench=${this.bench}&after=${this.next}&whole=${this.whole ? 1 : 0}`;
    const response = await fetch(`/desk/rows?${query}`);
    if (!response.ok) throw new Error(response.status);
    const reply = await response.json();
    // the page will soon get the settings of this vehicle
    if (reply.vehicle !== this.settings.vehicle) return;

    if (reply.bench !== this.bench) {
      this.rows = [];
      this.bench = reply.bench;
    }
    this.heldSpeed = reply.held_m_s;
    this.newest = reply.newest;
    this.marks = reply.marks;
    this.braked = reply.braked_m;
    this.next = reply.points;

    if (this.whole) {
      this.rows = reply.rows;
    } else {
      this.rows = this.rows.concat(reply.rows);
      this.dropOldRows();
    }
  },

  // Removes rows that are older than the span of the plots.
  dropOldRows() {
    const oldest_s = this.lastTime() - this.settings.span_s;
    const first = this.rows.findIndex((row) => row[0] >= oldest_s);
    if (first > 0) this.rows.splice(0, first);
  },

  // Returns the time of the last row in s, or 0 without rows. Column 0 of a row is its time.
  lastTime() {
    if (!this.rows.length) return 0;
    return this.rows[this.rows.length - 1][0];
  },

  // Draws the plots, the lanes of the valves and the figures.
  draw() {
    const last = this.lastTime();
    const begin = this.whole ? 0 : Math.max(0, last - this.settings.span_s);
    const end = Math.max(last, begin + 1);
    this.settings.plots.forEach((plot, index) => this.drawPlot(plot, begin, end, index === 0));
    this.drawValves(begin, end);
    this.drawFigures();
    if (this.settings.motors) this.drawMotors();
    if (this.settings.magnets) this.drawMagnets();
  },

  // Writes the torque of each motor below its axle, or that slide control has released it.
  drawMotors() {
    for (let axle = 1; axle <= this.axles; axle++) {
      const place = document.getElementById(`desk-motor-${axle}`);
      const demand_Nm = this.newestValue(`dynamic_torque_demand_${axle}_Nm`);
      const torque_Nm = this.newestValue(`dynamic_torque_${axle}_Nm`);
      const share = this.newestValue(`dynamic_share_${axle}`);
      const acts = demand_Nm || Math.abs(torque_Nm) > LEAST_TORQUE_Nm;
      let text = "";
      if (demand_Nm && share === 0) text = "motor released";
      else if (acts) text = `motor ${numberText(torque_Nm / 1000, 1)} kN m`;
      place.textContent = text;
      place.classList.toggle("desk-released", text === "motor released");
    }
  },

  // Lowers the drawn magnets of each bogie; on the rail they have another colour.
  drawMagnets() {
    for (let axle = 1; axle <= this.axles; axle += 2) {
      const lowered = this.newestValue(`track_brake_lowered_${axle}`) ?? 0;
      const magnet = document.getElementById(`desk-magnet-${axle}`);
      magnet.setAttribute("y", MAGNET_Y + MAGNET_DROP * lowered);
      magnet.classList.toggle("desk-on-rail", lowered > ON_RAIL);
    }
  },

  // Draws one plot. Only the first plot has the names of the faults at their marks.
  drawPlot(plot, begin, end, named) {
    const chart = getElement(plot.id)?.chart;
    if (!chart || chart.isDisposed()) return;
    const data = plot.lines.map((line) => ({ limit: line.limit, data: this.points(line, plot.scale) }));
    const yAxis = verticalRange(data, plot.least);
    const series = plot.lines.map((line, index) => ({ id: line.column, data: data[index].data }));
    series[0].markLine = this.faultLines(begin, end, named);
    const title = { text: plot.title + this.limitsText(plot) };
    chart.setOption({ title, xAxis: { min: begin, max: end }, yAxis, series }, { lazyUpdate: true });
  },

  // Returns the present limits of a plot in words, also those above its vertical axis.
  limitsText(plot) {
    const values = plot.lines
      .filter((line) => line.limit && (!this.axle || line.axle === this.axle))
      .map((line) => this.newestValue(line.column))
      .filter((value) => value !== undefined && value !== null);
    if (!values.length) return "";
    const low = numberText(Math.min(...values) * plot.scale, 3);
    return `; limits ${low} to ${numberText(Math.max(...values) * plot.scale, 3)}`;
  },

  // Returns the vertical lines where faults began (dashed) and were lifted (dotted).
  faultLines(begin, end, named) {
    const shown = this.marks.filter(([time]) => time >= begin && time <= end);
    const data = shown.map(([time, name, begins], index) => ({
      xAxis: time,
      lineStyle: { color: this.ink.bad, type: begins ? "dashed" : "dotted", width: 1.5 },
      label: {
        show: named,
        formatter: begins ? name : `${name} lifted`,
        // beside the line; the names of neighbours are on different heights
        position: "insideEnd",
        rotate: 0,
        align: time > (begin + end) / 2 ? "right" : "left",
        verticalAlign: "top",
        offset: [time > (begin + end) / 2 ? -4 : 4, MARK_ROW_PX * (index % MARK_ROWS)],
        color: this.ink.bad,
        backgroundColor: `${this.ink.back}cc`,
        fontSize: 11,
      },
    }));
    return { symbol: "none", silent: true, animation: false, data };
  },

  // Returns the points [time, value] of a line; none if the line belongs to an axle that is not drawn.
  points(line, scale) {
    const drawn = !this.axle || !line.axle || line.axle === this.axle;
    if (!drawn) return [];
    const index = this.columnIndex[line.column];
    return this.rows.map((row) => {
      const value = row[index] === null ? null : row[index] * scale;
      return [row[0], value];
    });
  },

  // Returns the newest value of a column, or undefined without a bench.
  newestValue(column) {
    return this.newest?.[this.columnIndex[column]];
  },

  drawFigures() {
    const put = (name, text) => {
      document.getElementById(`desk-${name}`).textContent = text;
    };

    let time = "no bench";
    let demand_bar = null;
    let sliding_m_s = null;
    if (this.newest) {
      time = `${numberText(this.newestValue("time_s"), 1)} s`;
      demand_bar = this.newestValue("brake_demand_Pa") / 1e5;
      sliding_m_s = this.largestSliding();
    } else if (this.heldSpeed !== null) {
      time = "held";
    }

    // while the rig is held, its speed is known but there is no row
    const speed_m_s = this.heldSpeed ?? this.newestValue("vehicle_speed_m_s");
    put("time", time);
    put("speed", numberText(kilometresPerHour(speed_m_s), 1));
    put("distance", numberText(this.newestValue("position_m"), 0));
    put("braked", numberText(this.braked, 0));
    put("demand", numberText(demand_bar, 2));
    put("sliding", numberText(sliding_m_s, 2));
  },

  // Returns the largest newest sliding speed of all axles in m/s.
  largestSliding() {
    const slidings = [];
    for (let axle = 1; axle <= this.axles; axle++) slidings.push(this.newestValue(`sliding_${axle}_m_s`));
    return Math.max(...slidings);
  },

  // Draws one lane an axle, in the colour of the state of its valve.
  drawValves(begin, end) {
    const canvas = document.getElementById("desk-valves");
    if (!canvas) return;
    // a new width clears the canvas, and keeps it sharp when the window changes
    canvas.width = canvas.clientWidth;
    const pen = canvas.getContext("2d");
    const laneHeight = canvas.height / this.axles;
    const laneWidth = canvas.width - LANES_LEFT - LANES_RIGHT;
    const toX = (time) => LANES_LEFT + ((time - begin) / (end - begin)) * laneWidth;

    pen.clearRect(0, 0, canvas.width, canvas.height);
    pen.font = `${Math.min(11, laneHeight + 1)}px sans-serif`;
    for (let axle = 1; axle <= this.axles; axle++) {
      const top = (axle - 1) * laneHeight;
      pen.fillStyle = this.settings.axles[axle - 1];
      pen.fillRect(0, top + 1, 4, laneHeight - 2);
      pen.fillStyle = this.ink.text;
      pen.fillText(`axle ${axle}`, 8, top + laneHeight / 2 + 4);
      const drawn = !this.axle || this.axle === axle;
      if (drawn) this.drawLane(pen, axle, top, laneHeight, toX);
    }
    pen.fillStyle = this.ink.bad;
    for (const [time] of this.marks) {
      if (time >= begin && time <= end) pen.fillRect(toX(time), 0, 1.5, canvas.height);
    }
  },

  drawLane(pen, axle, top, height, toX) {
    const index = this.columnIndex[`valve_${axle}`];
    for (let k = 0; k + 1 < this.rows.length; k++) {
      const state = Math.round(this.rows[k][index] ?? 0);
      const left = toX(this.rows[k][0]);
      const right = toX(this.rows[k + 1][0]);
      pen.fillStyle = this.settings.valves[Math.min(2, state)];
      // half a pixel more closes the gap to the next rectangle
      // the height shows the state, too: fill is low, hold is half, vent is whole
      const share = LANE_SHARES[Math.min(2, state)];
      const high = (height - LANE_GAP) * share;
      pen.fillRect(left, top + height - LANE_GAP / 2 - high, Math.max(1, right - left + 0.5), high);
    }
  },

  // Returns whether the page has the place of this vehicle, and draws the vehicle there once.
  placeVehicle() {
    const place = document.getElementById("desk-rig");
    if (place?.dataset.vehicle !== this.settings.vehicle) return false;
    if (!place.firstChild) this.drawVehicle(place);
    return true;
  },

  // Draws the vehicle on its bogies, with its wheels on rollers.
  drawVehicle(place) {
    const bogies = bogiePlaces(this.axles / 2);
    const width = pictureWidth(bogies.length);
    const height = HEIGHT + (this.settings.motors ? HEIGHT_OF_MOTOR_TEXT : 0);
    const pictures = bogies.map((x, index) => this.bogiePicture(x, index));
    place.innerHTML = `
      <svg viewBox="0 ${TOP} ${width} ${height}" role="img" aria-label="the rig from the side"
        style="--rig-text: ${Math.max(1, width / WIDE) * TEXT_SIZE}px">
        <rect x="10" y="${TOP + 2}" width="${width - 20}" height="18" rx="7" class="desk-coach"/>
        ${pictures.join("")}
      </svg>`;
  },

  // Returns the picture of a bogie at a place: frame, magnets and two wheels.
  bogiePicture(x, index) {
    const wheels = [x - HALF_WHEELBASE, x + HALF_WHEELBASE];
    const frames = wheels.map(
      (place) => `<line x1="${place}" y1="50" x2="${place}" y2="${WHEEL_Y}" class="desk-frame"/>`,
    );
    const pictures = wheels.map((place, at) => this.wheelPicture(place, 2 * index + at + 1));
    let magnets = "";
    if (this.settings.magnets) {
      magnets = `<rect id="desk-magnet-${2 * index + 1}" x="${x - 20}" y="${MAGNET_Y}" width="40"
        height="8" class="desk-magnet"/>`;
    }
    return `
      ${frames.join("")}
      <rect x="${x - 76}" y="46" width="152" height="7" class="desk-bogie"/>
      ${magnets}
      ${pictures.join("")}`;
  },

  // Returns the picture of a roller, the wheel on it, and the number of its axle.
  wheelPicture(x, axle) {
    const colour = this.settings.axles[axle - 1];
    const spokes = SPOKES_DEG.map(
      (angle) => `
        <line x1="${x - 24}" y1="${WHEEL_Y}" x2="${x + 24}" y2="${WHEEL_Y}"
          transform="rotate(${angle} ${x} ${WHEEL_Y})" class="desk-spoke"/>`,
    );
    let motorText = "";
    if (this.settings.motors) {
      motorText = `<text x="${x}" y="160" class="desk-text desk-motor" id="desk-motor-${axle}"></text>`;
    }
    return `
      <path d="M ${x - 24} 126 a 24 24 0 0 1 48 0 z" class="desk-roller"/>
      <g id="desk-wheel-${axle}" style="transform-origin:${x}px ${WHEEL_Y}px">
        <circle cx="${x}" cy="${WHEEL_Y}" r="26" class="desk-wheel" style="stroke:${colour}"/>
        ${spokes.join("")}
      </g>
      <text x="${x}" y="145" class="desk-text" id="desk-lock-${axle}">${axle}</text>
      ${motorText}`;
  },

  // Turns the drawn wheels by the time since the last picture, and requests the next picture.
  turnWheels(now) {
    const elapsed_s = Math.min(LONGEST_FRAME_S, (now - this.lastFrame) / 1000);
    this.lastFrame = now;
    for (let axle = 1; axle <= this.axles; axle++) this.turnWheel(axle, elapsed_s);
    requestAnimationFrame((next) => this.turnWheels(next));
  },

  turnWheel(axle, elapsed_s) {
    const wheel = document.getElementById(`desk-wheel-${axle}`);
    if (!wheel) return;
    const { moving_m_s, locked_m_s, radius_m } = this.settings;
    const speed = this.heldSpeed ?? this.newestValue(`wheel_circumferential_speed_${axle}_m_s`) ?? 0;
    const vehicleSpeed = this.heldSpeed ?? this.newestValue("vehicle_speed_m_s") ?? 0;
    const locked = vehicleSpeed > moving_m_s && speed < locked_m_s;

    this.angles[axle - 1] += (elapsed_s * speed) / radius_m / SLOW_MOTION;
    wheel.style.transform = `rotate(${this.angles[axle - 1]}rad)`;
    wheel.classList.toggle("desk-locked", locked);
    document.getElementById(`desk-lock-${axle}`).textContent = locked ? `${axle}: locked` : `${axle}`;
  },
};

// the scheme of the system may change at any time, and a chart may come at any time
const LOOK_AT_CHARTS_MS = 250;
setInterval(() => desk.colourCharts(), LOOK_AT_CHARTS_MS);

// The heads of a table that sort it are buttons for the keyboard, too.
function sortsBy(event) {
  const head = event.target.closest?.("th.sortable");
  if (!head || !["Enter", " "].includes(event.key)) return;
  event.preventDefault();
  head.click();
}
document.addEventListener("keydown", sortsBy);
setInterval(() => {
  for (const head of document.querySelectorAll("th.sortable:not([tabindex])")) head.tabIndex = 0;
}, LOOK_AT_CHARTS_MS);

"use strict";
// Steps through episodes around the view sphere. Everything it shows is in the JSON beside it; the address holds the state.
(() => {
  const data = JSON.parse(document.getElementById("trajectories").textContent);
  const $ = (id) => document.getElementById(id);
  const canvas = $("sphere"), pen = canvas.getContext("2d");
  const state = { scene: 0, policy: data.scenes[0].episodes[0].policy, step: 0, yaw: -0.7, pitch: 0.42 };
  const OBJECT = 0.62; // the object is drawn smaller than its sphere, so that the views stay clear of it

  const scene = () => data.scenes[state.scene];
  const episode = () => scene().episodes.find((e) => e.policy === state.policy) || scene().episodes[0];

  const decoded = (text) => text ? new Int8Array(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer) : [];
  const clouds = data.scenes.map((s) => ({ object: decoded(s.cloud), things: decoded(s.world && s.world.things) }));

  function project([x, y, z], size) {
    const cy = Math.cos(state.yaw), sy = Math.sin(state.yaw), cp = Math.cos(state.pitch), sp = Math.sin(state.pitch);
    const right = -sy * x + cy * y, away = cy * x + sy * y;
    const up = cp * z - sp * away, near = sp * z + cp * away;
    const scale = (size * 0.43 * 4) / (4 - near);
    return [size / 2 + scale * right, size * 0.54 - scale * up, near];
  }

  function between(a, b, steps) { // great circle
    const dot = Math.min(1, Math.max(-1, a[0] * b[0] + a[1] * b[1] + a[2] * b[2])), angle = Math.acos(dot);
    return Array.from({ length: steps + 1 }, (_, i) => {
      if (angle < 1e-6) return a;
      const t = i / steps, p = Math.sin((1 - t) * angle) / Math.sin(angle), q = Math.sin(t * angle) / Math.sin(angle);
      const v = [0, 1, 2].map((k) => p * a[k] + q * b[k]), n = Math.hypot(...v) || 1;
      return v.map((c) => (1.02 * c) / n);
    });
  }

  function line(points, size, colour, width) {
    for (let i = 1; i < points.length; i++) {
      const a = project(points[i - 1], size), b = project(points[i], size);
      pen.globalAlpha = a[2] + b[2] > -0.4 ? 1 : 0.35;
      pen.strokeStyle = colour; pen.lineWidth = width;
      pen.beginPath(); pen.moveTo(a[0], a[1]); pen.lineTo(b[0], b[1]); pen.stroke();
    }
    pen.globalAlpha = 1;
  }

  function dot(at, radius, fill, ring) {
    pen.beginPath(); pen.arc(at[0], at[1], radius, 0, 7);
    if (fill) { pen.fillStyle = fill; pen.fill(); }
    if (ring) { pen.strokeStyle = ring; pen.lineWidth = Math.max(1.5, radius / 4); pen.stroke(); }
  }

  function cross(at, radius) {
    pen.strokeStyle = "#8b97a3"; pen.lineWidth = 1.6;
    pen.beginPath();
    for (const way of [-1, 1]) { pen.moveTo(at[0] - radius, at[1] - way * radius); pen.lineTo(at[0] + radius, at[1] + way * radius); }
    pen.stroke();
  }

  function draw() {
    const size = canvas.clientWidth || 400, ratio = window.devicePixelRatio || 1;
    if (canvas.width !== Math.round(size * ratio)) canvas.width = canvas.height = Math.round(size * ratio);
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, size, size);
    const n = data.azimuths, d = data.directions, shown = episode();
    for (let first = 0; first < d.length; first += n) { // the rings
      const ring = Array.from({ length: 49 }, (_, i) => {
        const a = (2 * Math.PI * i) / 48, r = Math.hypot(d[first][0], d[first][1]);
        return [r * Math.cos(a), r * Math.sin(a), d[first][2]];
      });
      line(ring, size, "#2c3742", 1);
    }
    const world = scene().world, object = world ? world.scale : OBJECT; // among others all is as large as it is
    const points = [];
    for (const [cloud, scale, thing] of [[clouds[state.scene].object, object, false], [clouds[state.scene].things, 1, true]])
      for (let i = 0; i < cloud.length; i += 3)
        points.push([...project([0, 1, 2].map((k) => (scale * cloud[i + k]) / 127), size), thing]);
    points.sort((a, b) => a[2] - b[2]);
    for (const [x, y, near, thing] of points) {
      const light = Math.round(150 + 95 * Math.min(1, Math.max(-1, near / (world ? 0.8 : OBJECT))));
      pen.fillStyle = thing ? `rgb(${light - 10},${light >> 1},${light >> 1})` : `rgb(${light - 30},${light - 10},${light})`;
      pen.fillRect(x - 1.1, y - 1.1, 2.2, 2.2);
    }
    d.forEach((direction, v) => { // the views, the lighter the more depth-entropy they have, or the more they show
      const at = project(direction, size), e = world ? world.shows[v] : scene().entropy[v];
      pen.globalAlpha = at[2] > -0.2 ? 1 : 0.4;
      if (world && world.unreachable.includes(v)) cross(at, 4.2);
      else dot(at, 4.2, `rgb(${Math.round(60 + 190 * e)},${Math.round(80 + 130 * e)},${Math.round(130 - 30 * e)})`);
      pen.globalAlpha = 1;
    });
    const views = shown.views.slice(0, state.step + 1);
    for (let k = 1; k < views.length; k++) line(between(d[views[k - 1]], d[views[k]], 20), size, "#ffd166", 2.6);
    views.forEach((v, k) => {
      const at = project(d[v].map((c) => 1.02 * c), size), here = k === views.length - 1;
      dot(at, here ? 12 : 10, here ? "#ffd166" : "#e9eef3", k === 0 ? "#ef476f" : null);
      pen.fillStyle = "#10151b"; pen.font = "600 12px system-ui, sans-serif";
      pen.textAlign = "center"; pen.textBaseline = "middle";
      pen.fillText(String(k + 1), at[0], at[1] + 0.5);
    });
  }

  function element(tag, props, ...inside) {
    const e = Object.assign(document.createElement(tag), props);
    e.append(...inside);
    return e;
  }

  const where = (v) => `elevation ${data.angles[v][0]}°, azimuth ${data.angles[v][1]}°`;
  const pretty = (name) => name.replaceAll("_", " ");

  function tell() {
    const s = scene(), e = episode(), truth = s.label;
    const list = e.views.map((v, k) => {
      const picture = s.pictures[v]
        ? [element("img", { src: s.pictures[v], alt: `${s.name} from view ${v}, ${where(v)}` })] : [];
      const bars = e.beliefs[k].map(([c, p]) => {
        const kind = c === truth ? " true" : p === e.beliefs[k][0][1] ? " wrong" : "";
        const bar = element("i", {});
        bar.style.width = `${100 * p}%`;
        return element("div", { className: "bar" + kind },
          element("span", { textContent: pretty(data.classes[c]) }), element("div", {}, bar),
          element("em", { textContent: `${(100 * p).toFixed(1)} %` }));
      });
      const shows = s.world ? `, ${Math.round(100 * s.world.shows[v])} % shows` : "";
      const title = element("div", { className: "where", textContent: `${k + 1}: view ${v}, ${where(v)}${shows}` });
      const className = (k > state.step ? "ahead" : "") + (picture.length ? "" : " plain");
      const item = element("li", { className, onclick: () => go({ step: k }) },
        ...picture, element("div", {}, title, ...bars));
      if (k === state.step) item.setAttribute("aria-current", "step");
      return item;
    });
    $("steps").replaceChildren(...list);
    const [answer, sure] = e.beliefs[state.step][0], last = state.step === e.views.length - 1;
    const right = answer === truth ? "right" : "wrong";
    $("verdict").textContent = `${e.policy}, view ${state.step + 1} of ${e.views.length}: ` +
      `${last ? "answers" : "believes"} ${pretty(data.classes[answer])} (${(100 * sure).toFixed(1)} %), ` +
      `${right}; travelled ${e.travel[state.step].toFixed(2)} cells`;
    $("verdict").style.color = `var(--${right})`;
    $("why").textContent = `${s.name}, a ${pretty(data.classes[truth])}: ${s.why}.`;
    canvas.setAttribute("aria-label", `View sphere around ${s.name} with the path of ${e.policy} through views ` +
      e.views.slice(0, state.step + 1).join(", "));
    $("back").disabled = state.step === 0;
    $("next").disabled = last;
  }

  function choices() {
    $("scene").replaceChildren(...data.scenes.map((s, i) =>
      element("option", { value: String(i), textContent: `${s.name} from view ${s.start}`, selected: i === state.scene })));
    $("policy").replaceChildren(...scene().episodes.map((e) =>
      element("option", { value: e.policy, textContent: e.policy, selected: e === episode() })));
  }

  function go(change, remember = true) {
    Object.assign(state, change);
    state.scene = Math.min(Math.max(0, state.scene | 0), data.scenes.length - 1);
    state.policy = episode().policy;
    state.step = Math.min(Math.max(0, state.step | 0), episode().views.length - 1);
    if (remember) history.replaceState(null, "", `#scene=${state.scene}&policy=${encodeURIComponent(state.policy)}&step=${state.step}`);
    choices(); tell(); draw();
  }

  function fromAddress() {
    const wanted = new URLSearchParams(location.hash.slice(1));
    if (wanted.has("scene"))
      go({ scene: +wanted.get("scene"), policy: wanted.get("policy") || state.policy, step: +wanted.get("step") }, false);
  }

  $("scene").onchange = (event) => go({ scene: +event.target.value, step: 0 });
  $("policy").onchange = (event) => go({ policy: event.target.value, step: 0 });
  $("back").onclick = () => go({ step: state.step - 1 });
  $("next").onclick = () => go({ step: state.step + 1 });
  canvas.onkeydown = (event) => {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (step) { event.preventDefault(); go({ step: state.step + step }); }
  };
  let held = null;
  canvas.onpointerdown = (event) => { held = [event.clientX, event.clientY]; canvas.setPointerCapture(event.pointerId); };
  canvas.onpointermove = (event) => {
    if (!held) return;
    state.yaw -= (event.clientX - held[0]) / 120;
    state.pitch = Math.min(1.55, Math.max(-0.6, state.pitch + (event.clientY - held[1]) / 120));
    held = [event.clientX, event.clientY];
    draw();
  };
  canvas.onpointerup = canvas.onpointercancel = () => { held = null; };
  window.addEventListener("hashchange", fromAddress);
  window.addEventListener("resize", draw);
  go({}, false);
  fromAddress();
})();

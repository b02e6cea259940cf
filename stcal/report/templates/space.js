// A scene that turns: dragged, by touch, or with the keys; drawn from the JSON beside its canvas, parallel projection.
(() => {
  "use strict";
  const START = { azimuth: -58, elevation: 22, zoom: 0.98 };
  const STEP = 6;
  const rad = (degrees) => (degrees * Math.PI) / 180;

  function bounds(primitives) {
    const all = primitives.flatMap((each) => each.xyz);
    const low = [0, 1, 2].map((i) => Math.min(...all.map((p) => p[i])));
    const high = [0, 1, 2].map((i) => Math.max(...all.map((p) => p[i])));
    const centre = low.map((v, i) => (v + high[i]) / 2);
    return { centre, radius: Math.max(...all.map((p) => Math.hypot(...p.map((v, i) => v - centre[i]))), 1e-6) };
  }

  function show(figure) {
    const canvas = figure.querySelector("canvas");
    const data = JSON.parse(figure.querySelector("script").textContent);
    const told = figure.querySelector("output");
    const pen = canvas.getContext("2d");
    // What of the scene is shown, by the value of its button; it fills the picture.
    const parts = { all: bounds(data), target: bounds(data.filter((each) => each.target)) };
    let view = { ...START, part: figure.querySelector("button")?.value ?? "all" };
    let placed = [];

    function project(size) {
      const [a, e] = [rad(view.azimuth), rad(view.elevation)];
      const { centre, radius } = parts[view.part];
      const scale = (0.47 * Math.min(...size) * view.zoom) / radius;
      const [ca, sa, ce, se] = [Math.cos(a), Math.sin(a), Math.cos(e), Math.sin(e)];
      return (p) => {
        const [x, y, z] = p.map((v, i) => v - centre[i]);
        const along = x * ca + y * sa;
        return [size[0] / 2 + scale * (y * ca - x * sa), size[1] / 2 - scale * (z * ce - along * se), along * ce + z * se];
      };
    }

    function draw() {
      const ratio = window.devicePixelRatio || 1;
      const size = [canvas.clientWidth, canvas.clientHeight];
      if (!size[0]) return;
      [canvas.width, canvas.height] = size.map((v) => Math.round(v * ratio));
      pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      pen.clearRect(0, 0, ...size);
      const to = project(size);
      placed = data.filter((each) => view.part === "all" || each.target).map((each) => ({ each, at: each.xyz.map(to) }));
      // A body is convex: its faces that look away come first, then what lies behind it, then the others.
      const away = new Set(placed.filter(({ each, at }) => each.kind === "sheet" && area(at) > 0).map(({ each }) => each.face));
      for (const item of placed) {
        const { face, kind } = item.each;
        item.depth = item.at.reduce((sum, p) => sum + p[2], 0) / item.at.length;
        item.pale = face !== undefined && away.has(face);
        item.layer = face === undefined ? (item.depth < 0 ? 1 : 4) : item.pale ? 0 : kind === "sheet" ? 2 : 3;
      }
      placed.sort((one, two) => one.layer - two.layer || one.depth - two.depth);
      for (const item of placed) paint(item.each, item.at, item.pale);
    }

    // Twice the area of a polygon in the picture, negative where its corners run counterclockwise.
    const area = (at) => at.reduce((sum, [x, y], i) => {
      const [u, v] = at[(i + 1) % at.length];
      return sum + x * v - u * y;
    }, 0);

    function paint(each, at, pale) {
      pen.strokeStyle = pen.fillStyle = each.colour;
      pen.globalAlpha = pale ? 0.3 : 1;
      if (each.kind === "point") {
        pen.beginPath();
        pen.arc(at[0][0], at[0][1], each.size, 0, 7);
        pen.fill();
      } else if (each.kind === "text") {
        pen.font = "bold 15px sans-serif";
        pen.textAlign = "center";
        pen.textBaseline = "middle";
        pen.lineWidth = 4;
        pen.strokeStyle = "#fff";
        pen.strokeText(each.name, at[0][0], at[0][1]);
        pen.fillText(each.name, at[0][0], at[0][1]);
      } else {
        pen.beginPath();
        at.forEach((p, i) => (i ? pen.lineTo(p[0], p[1]) : pen.moveTo(p[0], p[1])));
        pen.lineWidth = each.size || 1;
        if (each.kind === "sheet") {
          pen.closePath();
          pen.fillStyle = pale ? "transparent" : "#e6ebf1";
          pen.fill();
        }
        pen.stroke();
      }
      pen.globalAlpha = 1;
    }

    function turn(azimuth, elevation) {
      view.azimuth = (view.azimuth + azimuth) % 360;
      view.elevation = Math.max(-90, Math.min(90, view.elevation + elevation));
      draw();
    }

    function zoom(factor) {
      view.zoom = Math.max(0.2, Math.min(40, view.zoom * factor));
      draw();
    }

    function reset(part) {
      view = { ...START, part };
      draw();
    }

    function name(x, y) {
      const near = placed.filter(({ each }) => each.name && each.kind !== "text").map(({ each, at }) =>
        [Math.hypot(at[0][0] - x, at[0][1] - y), each.name]);
      const [distance, found] = near.reduce((one, two) => (two[0] < one[0] ? two : one), [12, ""]);
      told.textContent = distance < 12 ? found : "";
    }

    const fingers = new Map();
    canvas.addEventListener("pointerdown", (event) => {
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      const was = fingers.get(event.pointerId);
      if (!was) return name(event.offsetX, event.offsetY);
      const now = [event.clientX, event.clientY];
      const other = [...fingers].find(([id]) => id !== event.pointerId);
      fingers.set(event.pointerId, now);
      if (other) zoom(Math.hypot(now[0] - other[1][0], now[1] - other[1][1]) /
        Math.max(Math.hypot(was[0] - other[1][0], was[1] - other[1][1]), 1));
      else turn(-0.5 * (now[0] - was[0]), 0.5 * (now[1] - was[1]));
    });
    for (const end of ["pointerup", "pointercancel"])
      canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
    canvas.addEventListener("wheel", (event) => {
      if (document.activeElement !== canvas && !event.ctrlKey) return;  // the page scrolls on
      event.preventDefault();
      zoom(Math.exp(-0.0015 * event.deltaY));
    }, { passive: false });
    const keys = {
      ArrowLeft: () => turn(-STEP, 0), ArrowRight: () => turn(STEP, 0), ArrowUp: () => turn(0, STEP),
      ArrowDown: () => turn(0, -STEP), "+": () => zoom(1.2), "-": () => zoom(1 / 1.2), 0: () => reset(view.part),
    };
    canvas.addEventListener("keydown", (event) => {
      if (!keys[event.key]) return;
      event.preventDefault();
      keys[event.key]();
    });
    for (const button of figure.querySelectorAll("button"))
      button.addEventListener("click", () => reset(button.value));
    new ResizeObserver(draw).observe(canvas);
    draw();
  }

  document.documentElement.classList.add("turning");
  document.querySelectorAll("figure.turn").forEach(show);
})();

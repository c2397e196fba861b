// Draws this document's figure with plotly, in the colours of the theme, and turns it to fixed views.
"use strict";

(() => {
  const place = document.getElementById("chart");
  const figure = JSON.parse(document.getElementById("figure").textContent);
  const dark = matchMedia("(prefers-color-scheme: dark)");

  const colours = () => {
    const themed = document.documentElement.dataset.theme;
    const night = themed === "dark" || (themed !== "light" && dark.matches);
    return night
      ? { ink: "#e4ebef", line: "#3b4a54", ground: "#10161a" }
      : { ink: "#15212a", line: "#c3ccd3", ground: "#ffffff" };
  };

  const dress = (layout) => {
    const c = colours();
    layout.paper_bgcolor = c.ground;
    layout.plot_bgcolor = c.ground;
    layout.font = { color: c.ink, family: "system-ui, sans-serif", size: 14 };
    layout.legend = { ...layout.legend, bgcolor: "rgba(0,0,0,0)" };
    for (const axis of ["xaxis", "yaxis", "zaxis"]) {
      if (layout.scene) {
        const now = layout.scene[axis] || {};
        layout.scene[axis] = { ...now, gridcolor: c.line, color: c.ink, backgroundcolor: c.ground, showbackground: false };
      }
    }
    layout.autosize = true;
    return layout;
  };

  for (const trace of figure.data) {
    if (trace.mode && trace.mode.includes("text")) {
      trace.textfont = { ...trace.textfont, color: colours().ink };
    }
  }

  const options = { responsive: true, displayModeBar: false, scrollZoom: true };
  place.textContent = "";
  Plotly.newPlot(place, figure.data, dress(figure.layout), options).then(
    () => place.setAttribute("data-drawn", ""),
    () => { place.textContent = "This browser cannot draw in 3D (WebGL). The tables say the same."; },
  );
  dark.addEventListener("change", () => Plotly.relayout(place, dress({ ...figure.layout })));

  // plotly's camera moves in units of a metre about the middle of the axes; views are given in millimetres of the drawing.
  const middle = (axis) => {
    const [low, high] = figure.layout.scene[axis].range;
    return (low + high) / 2;
  };
  const inBox = ([x, y, z]) => ({ x: (x - middle("xaxis")) / 1000, y: (y - middle("yaxis")) / 1000, z: (z - middle("zaxis")) / 1000 });
  const camera = () => place._fullLayout.scene._scene.getCamera();
  const look = (eye, centre) =>
    Plotly.relayout(place, { "scene.camera.eye": inBox(eye), "scene.camera.center": inBox(centre), "scene.camera.up": { x: 0, y: 0, z: 1 } });

  // From behind and above a robot's base, towards the middle.
  const fromStation = (name) => {
    const base = place._fullData.find((trace) => trace.name === `robot base, ${name}`);
    const [x, y] = base ? [base.x[0], base.y[0]] : [0, -1];
    const length = Math.hypot(x, y) || 1;
    return [[(1250 * x) / length, (1250 * y) / length, 850], [0, 0, 210]];
  };
  const views = {
    top: () => [[0, -2, 1700], [0, 0, 0]],
    front: () => [[0, -1600, 250], [0, 0, 250]],
    side: () => [[1600, 0, 250], [0, 0, 250]],
    station: fromStation,
  };

  document.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button || !place._fullLayout?.scene) return;
    const { view, station, zoom, turn } = button.dataset;
    if (view) {
      look(...views[view](station));
      return;
    }
    const { eye, center } = camera();
    const [x, y, z] = ["x", "y", "z"].map((axis) => eye[axis] - center[axis]);
    const factor = zoom ? Number(zoom) : 1;
    const angle = turn ? (Number(turn) * Math.PI) / 8 : 0;
    Plotly.relayout(place, {
      "scene.camera.eye": {
        x: center.x + factor * (x * Math.cos(angle) - y * Math.sin(angle)),
        y: center.y + factor * (x * Math.sin(angle) + y * Math.cos(angle)),
        z: center.z + factor * z,
      },
    });
  });
})();

// Pictures of an advice. It runs inside one function with page.js before it.
  const ROLES = { "fitted to": "#0072B2", "chosen by": "#009E73", "judged by": "#E69F00" };
  const [FIRST, OTHERS] = ["#D55E00", ["#0072B2", "#5a6472"]];
  const lineOf = (i) => ({ color: i ? OTHERS[(i - 1) % OTHERS.length] : FIRST, width: i ? 1.2 : 2 });

  // The use of each stretch of the log: a strip below the figure, on the same axis of time.
  function strip(spans) {
    return spans.map(([role, from, to]) => ({ type: "rect", xref: "x", yref: "paper", x0: from, x1: to, y0: 0, y1: 0.04, line: { width: 0 }, fillcolor: ROLES[role], opacity: 0.75 }));
  }
  function shade(spans) {
    return spans.filter(([role]) => role === "judged by").map(([role, from, to]) => ({ type: "rect", layer: "below", xref: "x", yref: "paper", x0: from, x1: to, y0: 0, y1: 1, line: { width: 0 }, fillcolor: ROLES[role], opacity: 0.09 }));
  }
  function legendOf(spans) {
    const roles = Object.keys(ROLES).filter((role) => spans.some((span) => span[0] === role));
    return roles.map((role) => ({ x: [null], y: [null], mode: "markers", name: role, marker: { color: ROLES[role], size: 11, symbol: "square" }, hoverinfo: "skip" }));
  }
  const time = { title: { text: "time, s since the first row" } };
  const reach = (seconds) => [seconds[0], seconds[seconds.length - 1]];

  // Parts of a line with measurements are solid, those without dotted; they are connected.
  function parts(values, isMissed) {
    const measured = values.map((y, i) => (isMissed[i] ? null : y));
    const missed = values.map((y, i) => (isMissed[i] || isMissed[i + 1] || (i && isMissed[i - 1]) ? y : null));
    return [measured, missed];
  }

  const FIGURES = {
    track({ names }, episode) {
      const { components, measured, estimates, outliers, outlier_numbers, outlier_seconds, seconds, truth, onboard } = episode, isPlane = components.length === 2;
      const isMissed = measured[0].map((x) => x === null);
      const at = (values) => (isPlane ? { x: values[0], y: values[1] } : { x: seconds, y: values[0] });
      const drawn = [];
      if (truth) drawn.push({ ...at(truth), mode: "lines", name: "truth", line: { color: css("--soft"), width: 5 }, opacity: 0.45 });
      drawn.push({ ...at(measured), mode: "markers", name: "measured", marker: { color: css("--soft"), size: 4, symbol: "cross-thin-open" }, text: seconds, hovertemplate: "%{text} s<extra>measured</extra>" });
      if (outlier_numbers.length) {
        const place = isPlane ? { x: outliers[0], y: outliers[1] } : { x: outlier_seconds, y: outliers[0] };
        drawn.push({ ...place, mode: "markers", name: "taken for outliers", marker: { color: "#CC79A7", size: 10, symbol: "circle-open", line: { width: 2 } }, text: outlier_numbers, hovertemplate: "measurement %{text}<extra>taken for an outlier</extra>" });
      }
      names.forEach((name, i) => {
        const [solid, dotted] = [0, 1].map((k) => at(estimates[i].map((values) => parts(values, isMissed)[k])));
        const shown = { name: plain(name), legendgroup: plain(name), text: seconds, visible: i ? "legendonly" : true, hovertemplate: "%{text} s<extra>" + plain(name) + "</extra>" };
        drawn.push({ ...solid, mode: "lines", line: lineOf(i), ...shown }, { ...dotted, mode: "lines", line: { ...lineOf(i), dash: "dot" }, ...shown, showlegend: false });
      });
      if (onboard) drawn.push({ ...at(onboard), mode: "lines", name: "on-board", line: { color: "#009E73", width: 1.2 }, connectgaps: true, text: seconds, hovertemplate: "%{text} s<extra>on-board</extra>" });
      const axes = isPlane ? { xaxis: { title: { text: plain(components[0]) } }, yaxis: { title: { text: plain(components[1]) }, scaleanchor: "x" } } : { xaxis: time, yaxis: { title: { text: plain(components[0]) } } };
      return [drawn, { ...axes, height: window.innerWidth < 640 ? 460 : 600 }];
    },
    innovations(_, { seconds, innovations, measured_names, spans }) {
      if (!innovations) return null;
      const drawn = innovations.map((values, i) => ({ x: seconds, y: values, mode: "markers", name: plain(measured_names[i]), marker: { size: 4, color: [FIRST, OTHERS[0], "#009E73"][i % 3], symbol: ["circle", "diamond", "square"][i % 3] }, opacity: 0.65 }));
      const far = 1.05 * Math.max(3.5, ...innovations.flat().filter((x) => x !== null).map(Math.abs));
      const band = [-1.96, 1.96].map((y) => ({ type: "line", xref: "paper", x0: 0, x1: 1, y0: y, y1: y, line: { color: css("--fg"), width: 1, dash: "dash" } }));
      return [[...drawn, ...legendOf(spans)], { shapes: [...shade(spans), ...strip(spans), ...band], xaxis: { ...time, range: reach(seconds) }, yaxis: { title: { text: "innovation over its deviation" }, range: [-far, far] } }];
    },
    nis({ names }, { seconds, nis, spans }, figure) {
      figure.querySelector(".size").textContent = nis[0].size;
      const edge = { x: nis[0].seconds, mode: "lines", line: { width: 0 }, hoverinfo: "skip", legendgroup: "band" };
      const drawn = [{ ...edge, y: nis[0].low, showlegend: false }, { ...edge, y: nis[0].high, fill: "tonexty", fillcolor: "rgba(128,128,128,0.25)", name: "95 % of a consistent one" }];
      names.forEach((name, i) => drawn.push({ x: nis[i].seconds, y: nis[i].mean, mode: "lines+markers", name: plain(name), line: lineOf(i), marker: { size: i ? 3 : 5 } }));
      const one = { type: "line", xref: "paper", x0: 0, x1: 1, y0: 1, y1: 1, line: { color: css("--fg"), width: 1 } };
      return [[...drawn, ...legendOf(spans)], { shapes: [...shade(spans), ...strip(spans), one], xaxis: { ...time, range: reach(seconds) }, yaxis: { title: { text: "mean NIS over its dimension" }, rangemode: "tozero" } }];
    },
  };

  function drawProfiles(box, { profiles, drop }) {
    const panels = profiles.map(() => box.appendChild(document.createElement("div")));
    const draw = () => profiles.forEach(({ title, is_log, values, drops, ends, best }, i) => {
      const shapes = [
        { type: "line", xref: "paper", x0: 0, x1: 1, y0: -drop, y1: -drop, line: { color: css("--soft"), width: 1, dash: "dot" } },
        { type: "line", yref: "paper", y0: 0, y1: 1, x0: best, x1: best, line: { color: css("--soft"), width: 1 } },
      ];
      const curve = { x: values, y: drops.map((y) => (y === null ? null : -y)), mode: "lines+markers", line: { color: FIRST, width: 2 }, marker: { size: 5 }, showlegend: false, hovertemplate: "%{x:.3g}: %{y:.2f} nats<extra></extra>" };
      const near = [...ends, ...values.filter((_, k) => drops[k] !== null && drops[k] < 12)].map((x) => (is_log ? Math.log10(x) : x));
      const [low, high] = [Math.min(...near), Math.max(...near)], margin = 0.06 * (high - low || 1);
      Plotly.react(panels[i], [curve], layout({ shapes, height: 250, margin: { l: 50, r: 10, t: 10, b: 45 }, xaxis: { title: { text: plain(title) }, type: is_log ? "log" : "linear", range: [low - margin, high + margin], nticks: 6 }, yaxis: { title: { text: "nats" }, range: [-8, 0.5] } }), { ...config, displayModeBar: false });
    });
    draw();
    redraw.push(draw);
  }

  async function start() {
    await library;
    const data = await unpacked(document.querySelector("#pictures > script.data")).json();
    let current = 0;
    for (const figure of document.querySelectorAll("#pictures figure")) {
      const box = figure.querySelector(".plot"), kind = figure.dataset.kind;
      try {
        if (kind === "profiles") { drawProfiles(box, data); continue; }
        const draw = () => {
          const found = FIGURES[kind](data, data.episodes[current], figure);
          if (found) Plotly.react(box, found[0], layout(found[1]), config);
        };
        draw();
        redraw.push(draw);
      } catch (error) { box.textContent = `This figure cannot be drawn: ${error.message}`; console.error(error); }
    }
    if (data.episodes.length > 1) {
      const select = document.createElement("select");
      select.setAttribute("aria-label", "track that is shown");
      data.episodes.forEach(({ name }, i) => select.append(new Option(name, i)));
      select.addEventListener("change", () => { current = Number(select.value); again(); });
      document.getElementById("episode").append("Track: ", select);
    }
    document.body.dataset.drawn = "done";
  }
  start();

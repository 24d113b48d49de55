// Figures of results, drawn when they are opened. It runs inside one function with page.js before it.
  // --- a dataset: variables with names of their dimensions, numbers in row-major order

  class Data {
    constructor(stored) {
      this.parts = new Map([...Object.entries(stored.coords), ...Object.entries(stored.variables)]);
      this.attrs = new Map(Object.entries(stored.attrs));
    }
    has(name) { return this.parts.has(name); }
    words(name) { const values = this.parts.get(name)[1]; return (Array.isArray(values) ? values : values.numbers).map(String); }
    numbers(name) { const values = this.parts.get(name)[1]; return Array.isArray(values) ? values : values.numbers; }
    // The last dimension of a variable at the given indices of those before.
    row(name, ...indices) {
      const { shape, numbers } = this.parts.get(name)[1];
      const start = indices.reduce((at, index, i) => at * shape[i] + index, 0);
      const length = shape.slice(indices.length).reduce((product, n) => product * n, 1);
      return numbers.slice(start * length, (start + 1) * length);
    }
    get stretches() { return this.numbers(this.has("stretch_elapsed") ? "stretch_elapsed" : "stretch"); }
    get time() { return this.has("elapsed") ? this.numbers("elapsed") : this.numbers("time"); }
    get clock() { return this.has("elapsed") ? "time, s" : "measurement"; }
  }
  const something = (values) => values.some((x) => x !== null);

  // --- style of lines: by kind, with one colour for a name in all figures of an environment

  function look(line) {
    const style = { color: css("--soft"), width: 1, dash: "solid" };
    if (line.origin === "yours") Object.assign(style, { color: OWN, width: 2.6 });
    else if (line.origin === "paper") Object.assign(style, { color: css("--fg"), width: 2 });
    else if (line.origin === "reference") Object.assign(style, { color: css("--fg"), width: 1.6, dash: "dash" });
    else if (line.origin === "bound") Object.assign(style, { color: css("--fg"), width: 1.6, dash: "dot" });
    else if (line.origin === "smoother") Object.assign(style, { color: css("--fg"), width: 1.6, dash: "dashdot" });
    else if (line.colour !== null && line.colour < COLOURS.length) Object.assign(style, { color: COLOURS[line.colour], width: line.origin === "learned" ? 2.6 : 1.6 });
    return style;
  }
  const isGrey = (line) => !["yours", "paper", "reference", "bound", "smoother"].includes(line.origin) && !(line.colour < COLOURS.length);
  const faint = (colour) => {
    const [r, g, b] = [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16));
    return `rgba(${r},${g},${b},0.16)`;
  };

  // --- lines with bands; indistinguishable ones are drawn once, with all their names

  function together(lines, of, [bottom, top], log) {
    const kept = [], at = (y) => log ? Math.log10(y) : y;
    const apart = (a, b) => a.reduce((most, y, i) => y === b[i] ? most : Math.max(most, y === null || b[i] === null ? Infinity : Math.abs(at(y) - at(b[i]))), 0);
    for (const line of lines) {
      const values = of(line);
      if (!values || !something(values.mid)) continue;
      const same = kept.find((other) => apart(other.values.mid, values.mid) <= 0.004 * (top - bottom));
      if (same) { same.names.push(line.name); same.exact = same.exact && apart(same.values.mid, values.mid) === 0; }
      else kept.push({ line, values, names: [line.name], exact: true });
    }
    return kept;
  }
  function named(names, exact) {
    const sign = exact ? " = " : " \u2248 ", all = names.map(plain);
    return { name: all.length > 2 ? `${all[0]}${sign}${all.length - 1} others` : all.join(sign), every: all.join(`${sign}<br>`) };
  }

  // Ends of an axis of the drawn values: numbers, or on a logarithmic axis their logarithms.
  function ends(lines, of, log) {
    const all = lines.flatMap((line) => (of(line).mid || []).filter((y) => y !== null && (!log || y > 0)).map((y) => log ? Math.log10(y) : y));
    const [low, high] = all.reduce(([l, h], y) => [Math.min(l, y), Math.max(h, y)], [Infinity, -Infinity]);
    return [low, high > low ? high : low + 1];
  }

  // A band is informative where it is narrow on the axis; wide ones hide each other and the lines.
  function isNarrow({ low, high }, [bottom, top], log) {
    const at = (y) => Math.min(Math.max(log ? Math.log10(Math.max(y, 1e-30)) : y, bottom), top);
    const widths = high.map((y, i) => y === null || low[i] === null ? 0 : at(y) - at(low[i]));
    return widths.reduce((sum, width) => sum + width, 0) / widths.length < 0.3 * (top - bottom);
  }

  function traces(lines, x, of, hover, log = false) {
    const drawn = [], axis = ends(lines, of, log);
    // Grey ones first: they lie below.
    for (const { line, values, names, exact } of together(lines, of, axis, log).sort((a, b) => isGrey(b.line) - isGrey(a.line))) {
      const style = look(line), { name, every } = named(names, exact), group = plain(line.name);
      if (values.low && !isGrey(line) && !["reference", "bound"].includes(line.origin) && isNarrow(values, axis, log)) {
        const fill = faint(style.color.length === 7 ? style.color : "#888888");
        const edge = { x, mode: "lines", line: { width: 0 }, hoverinfo: "skip", showlegend: false, legendgroup: group };
        drawn.push({ ...edge, y: values.low }, { ...edge, y: values.high, fill: "tonexty", fillcolor: fill });
      }
      drawn.push({ x, y: values.mid, mode: "lines", name, legendgroup: group, line: style, customdata: hover, opacity: isGrey(line) ? 0.6 : 1,
        hovertemplate: hover ? "%{y:.4g} at measurement %{customdata}<extra>" + every + "</extra>" : "%{y:.4g}, %{x:.4g}<extra>" + every + "</extra>" });
    }
    return drawn;
  }

  // --- choices of each figure, each a function that returns traces and layout

  function overTime(cell, variable, indices, title, changes = {}, [x, numbers] = [cell.curves.time, cell.curves.numbers("time")]) {
    const { curves, lines } = cell;
    const names = curves.words("policy");
    const of = (line) => {
      const at = [names.indexOf(line.name), ...indices];
      const row = (ending) => curves.has(variable + ending) && curves.row(variable + ending, ...at);
      return { mid: row(""), low: row("_low"), high: row("_high") };
    };
    const shapes = [];
    if (curves.has("window")) {
      const time = curves.numbers("time"), clock = curves.time;
      const at = (number) => clock[Math.max(0, time.findIndex((t) => t >= number))];
      const all = time[time.length - 1];
      const [first, last] = [curves.numbers("window_first"), curves.numbers("window_last")];
      curves.words("window").forEach((name, i) => {
        if (last[i] - first[i] + 1 < 0.85 * all) shapes.push({ type: "rect", xref: "x", yref: "paper", x0: at(first[i]), x1: at(last[i]), y0: 0, y1: 1, line: { width: 0 }, fillcolor: css("--soft"), opacity: i % 2 ? 0.1 : 0.06, layer: "below", label: { text: words(name), textposition: "top center", font: { size: 10, color: css("--soft") } } });
      });
    }
    const log = changes.type === "log", drawn = traces(lines, x, of, numbers, log);
    if (log) {
      const [bottom, top] = ends(lines, of, true), margin = 0.06 * (top - bottom);
      changes = { ...changes, range: [bottom - margin, top + margin] };
    }
    return [drawn, layout({ xaxis: { title: { text: curves.clock } }, yaxis: { title: { text: title }, ...changes }, shapes })];
  }

  const logarithmic = { type: "log", exponentformat: "none", dtick: "D2", minorloglabels: "complete" };

  const FIGURES = {
    front: (cell) => [["front", () => frontOf(cell.front, cell.paper)]],
    ranking: (cell) => [["cost", () => dotted([["", "", cell.ranking]], null, cell.paper)]],
    rmse: ({ curves, ...cell }) => curves.words("quantity").map((name, i) => [words(name), () =>
      overTime({ curves, ...cell }, "rmse", [i], `RMSE of ${words(name)}, ${plain(curves.words("unit")[i])}`, logarithmic)]),
    exceeded: ({ curves, lines }) => curves.words("quantity").map((name, i) => [words(name), () => {
      const names = curves.words("policy"), share = curves.numbers("share");
      const drawn = traces(lines, [], (line) => ({ mid: curves.row("error_exceeded", names.indexOf(line.name), i) }), null, true);
      for (const trace of drawn) [trace.x, trace.y, trace.hovertemplate] = [trace.y, share, "%{y:.3g} of measurements above %{x:.4g}" + trace.hovertemplate.slice(trace.hovertemplate.indexOf("<extra>"))];
      // Tiny errors are indistinguishable.
      const sizes = drawn.flatMap(({ x }) => x.filter((size, k) => size > 0 && share[k] < 0.9)), largest = Math.max(...drawn.flatMap(({ x }) => x));
      const range = [Math.log10(Math.min(...sizes) || 1), Math.log10(largest || 1) + 0.05];
      return [drawn, layout({ xaxis: { title: { text: `error of ${words(name)}, ${plain(curves.words("unit")[i])}` }, ...logarithmic, range }, yaxis: { title: { text: "share of measurements above" }, type: "log", exponentformat: "power", dtick: 1 } })];
    }]),
    difference: (cell) => [["paper", cell.paper], ["best", cell.curves.attrs.get("best")]]
      .filter(([key, name], i) => cell.curves.has(`cost_minus_${key}`) && !(i && name === cell.paper))
      .map(([key, name]) => [`less ${name}`, () => overTime(cell, `cost_minus_${key}`, [], `mean cost less that of ${plain(name)}`, {}, [cell.curves.stretches, cell.curves.numbers("stretch").map((number) => Math.round(number))])]),
    consistency: (cell) => ["anees", "anis"].filter((name) => cell.curves.has(name)).map((name) => [name.slice(1).toUpperCase(), () => {
      const { curves } = cell;
      const names = curves.words("policy");
      const drawn = traces(cell.lines, curves.time, (line) => ({ mid: curves.row(name, names.indexOf(line.name)) }), curves.numbers("time"), true);
      const edge = { x: curves.time, mode: "lines", line: { width: 0 }, hoverinfo: "skip", showlegend: false };
      const band = curves.has(name + "_low") ? [{ ...edge, y: curves.numbers(name + "_low") }, { ...edge, y: curves.numbers(name + "_high"), fill: "tonexty", fillcolor: "rgba(128,128,128,0.35)", name: "95 % of a consistent one", showlegend: true }] : [];
      return [[...band, ...drawn], layout({ xaxis: { title: { text: curves.clock } }, yaxis: { title: { text: `mean ${name.slice(1).toUpperCase()} over its dimension` }, ...logarithmic }, shapes: [{ type: "line", xref: "paper", x0: 0, x1: 1, y0: 1, y1: 1, line: { color: css("--fg"), width: 1 } }] })];
    }]),
    steering: (cell) => {
      const { curves } = cell, probability = { range: [-0.02, 1.02] };
      const kinds = [["true_class_probability", null, "weight of the true class", probability], ["gain", "gain_name", "gain", {}], ["action", "action_name", "action", {}], ["mode_probability", "mode", "probability", probability]];
      const found = kinds.filter(([variable]) => curves.has(variable)).flatMap(([variable, names, kind, axis]) =>
        (names === null ? [null] : curves.words(names)).map((name, i) => {
          const title = name === null ? kind : `${kind}: ${words(name)}`, indices = name === null ? [] : [i];
          const varies = (line) => { const values = curves.row(variable, curves.words("policy").indexOf(line.name), ...indices).filter((y) => y !== null); return values.some((y) => Math.abs(y - values[0]) > 1e-6); };
          return { moving: cell.lines.filter(varies).length, choice: [title, () => overTime(cell, variable, indices, title, axis)] };
        }));
      // An action that no competitor changes has no picture; the one that most change comes first.
      return found.filter(({ moving }) => moving).sort((a, b) => b.moving - a.moving).map(({ choice }) => choice);
    },
  };

  // Competitors beyond the axis.
  const over = (end, names) => `over +${Math.round(end)} %: ${names.slice(0, 3).join(", ")}${names.length > 3 ? ` and ${names.length - 3} more` : ""}`;

  function dotted(rows, lines, paper) {
    // One row: a line for each competitor; several: a line for each scenario, competitors beside each other.
    const single = lines === null;
    const entries = single ? rows[0][2].map(([name, origin]) => ({ name, origin, colour: null })) : lines;
    const drawn = entries.map((line, i) => {
      const x = [], y = [], low = [], high = [], text = [];
      rows.forEach(([scenario, role, found], row) => {
        const entry = found.find(([name]) => name === line.name);
        if (!entry) return;
        const [, , value, from, to] = entry;
        x.push(value); low.push(Math.max(value - from, 0)); high.push(Math.max(to - value, 0));
        y.push(single ? plain(line.name) : row + 0.8 * ((i + 0.5) / entries.length - 0.5));
        text.push(`${value.toFixed(1)} [${from.toFixed(1)}, ${to.toFixed(1)}] %${single ? "" : ", " + plain(scenario)}`);
      });
      const style = look(single && !["yours", "paper", "reference"].includes(line.origin) ? { ...line, colour: line.origin === "learned" ? 0 : line.origin === "estimator" ? 2 : 1 } : line);
      return { x, y, text, mode: "markers", name: plain(line.name), showlegend: !single, hovertemplate: "%{text}<extra>" + plain(line.name) + "</extra>",
        marker: { color: style.color, size: single ? 8 : 7, symbol: { learned: "diamond", reference: "square-open", estimator: "triangle-up", yours: "cross" }[line.origin] || "circle" },
        error_x: { type: "data", symmetric: false, array: high, arrayminus: low, color: style.color, thickness: 1.2, width: 0 } };
    });
    // Beyond three times the paper's cost a point is on the edge: near zero is where they differ visibly.
    const ends = drawn.flatMap(({ x, error_x }) => x.flatMap((value, i) => [value - error_x.arrayminus[i], value + error_x.array[i]]));
    const range = [Math.max(-100, Math.min(...ends, 0) * 1.05 - 3), Math.min(200, Math.max(...ends, 5) * 1.05 + 3)];
    const beyond = drawn.filter(({ x }) => x.some((value) => value > range[1])).map(({ name }) => name);
    const narrow = window.innerWidth < 640;
    const title = `cost against ${plain(paper || "the paper")}, %` + (beyond.length ? `<br>(${over(range[1], beyond)})` : "");
    const yaxis = single
      ? { automargin: true, categoryorder: "array", categoryarray: entries.map((line) => plain(line.name)).reverse(), tickfont: { size: narrow ? 9 : 11 }, dtick: 1 }
      : { tickvals: rows.map((_, i) => i), ticktext: rows.map(([scenario, role]) => `${plain(scenario)}<br><i>${plain(role)}</i>`), range: [rows.length - 0.5, -0.5], zeroline: false, tickfont: { size: narrow ? 9 : 11 } };
    const shapes = single ? [] : rows.flatMap((_, i) => i % 2 ? [] : [{ type: "rect", xref: "paper", x0: 0, x1: 1, y0: i - 0.5, y1: i + 0.5, fillcolor: css("--soft"), opacity: 0.07, line: { width: 0 }, layer: "below" }]);
    const height = single ? Math.max(280, 110 + 19 * entries.length) : (narrow ? 270 : 190) + rows.length * Math.max(44, 11 * entries.length);
    const legend = single ? {} : { legend: { ...layout({}).legend, yref: "container", y: 0, yanchor: "bottom" } };
    return [drawn, layout({ xaxis: { title: { text: title }, range, zeroline: true, zerolinewidth: 2 }, yaxis, shapes, height, ...legend })];
  }

  // --- cost and time: a point for each competitor, steps along the front, a line for the reference

  function frontOf(points, paper) {
    const ranked = points.filter(([, origin]) => origin !== "reference"), reference = points.find(([, origin]) => origin === "reference");
    // Beyond twice the paper's cost no competitor is on the front.
    const most = Math.min(100, Math.max(5, ...ranked.map(([, , , cost]) => cost)));
    const top = Math.max(most, ...ranked.filter(([, origin]) => origin === "yours").map(([, , , cost]) => cost)), shown = ranked.filter(([, , , cost]) => cost <= top);
    const steps = shown.filter(([, , , , , on]) => on).sort((a, b) => a[2] - b[2]), times = shown.map(([, , time]) => time);
    const right = Math.max(...times) * 1.6, left = Math.min(...times) / 1.3;
    const drawn = [{ x: [...steps.map((p) => p[2]), right], y: [...steps.map((p) => p[3]), (steps[steps.length - 1] || [0, 0, 0, 0])[3]], mode: "lines", name: "the front", line: { shape: "hv", color: css("--fg"), width: 1.4 }, hoverinfo: "skip" }];
    for (const kind of ["paper", "classical", "estimator", "learned", "yours"]) {
      const own = shown.filter(([, origin]) => origin === kind);
      if (!own.length) continue;
      const color = look({ origin: kind, colour: { learned: 0, classical: 1, estimator: 2 }[kind] ?? null }).color;
      drawn.push({ x: own.map((p) => p[2]), y: own.map((p) => p[3]), name: kind, mode: "markers+text", cliponaxis: false,
        text: own.map(([name, , , , , on]) => on || kind === "yours" ? plain(name) : ""), textposition: own.map(([, , time]) => time < Math.sqrt(left * right) ? "bottom right" : "bottom left"), textfont: { size: 10 },
        customdata: own.map(([name, , , , compiled]) => plain(name) + (compiled ? "" : ", asked in Python")),
        hovertemplate: "%{y:.1f} %, %{x:.3g} ns<extra>%{customdata}</extra>",
        marker: { color, size: 8, line: { color, width: 1.2 }, symbol: own.map(([, , , , compiled]) => ({ paper: "star", learned: "diamond", estimator: "square", yours: "cross" }[kind] || "circle") + (compiled ? "" : "-open")) } });
    }
    if (reference) drawn.push({ x: [left, right], y: [reference[3], reference[3]], mode: "lines", name: plain(reference[0]), line: { color: css("--fg"), width: 1.4, dash: "dash" }, hovertemplate: `%{y:.1f} %, ${reference[2].toPrecision(2)} ns<extra>${plain(reference[0])}</extra>` });
    const beyond = ranked.filter((point) => !shown.includes(point)).map(([name]) => plain(name)), low = Math.min(...drawn.flatMap(({ y }) => y));
    const title = `cost against ${plain(paper || "the paper")}, %`;
    const annotations = beyond.length ? [{ xref: "paper", yref: "paper", x: 1, y: 1, xanchor: "right", yanchor: "top", showarrow: false, text: over(top, beyond) }] : [];
    return [drawn, layout({ annotations, xaxis: { title: { text: "nanoseconds a measurement" }, ...logarithmic, range: [left, right].map(Math.log10) }, yaxis: { title: { text: title }, range: [low - 0.08 * (top - low), top + 0.05 * (top - low)] } })];
  }

  // --- a track with a slider

  function ellipse(x, y, xx, xy, yy) {
    const mean = (xx + yy) / 2, root2 = Math.hypot((xx - yy) / 2, xy), angle = 0.5 * Math.atan2(2 * xy, xx - yy);
    const [a, b] = [2 * Math.sqrt(Math.max(mean + root2, 0)), 2 * Math.sqrt(Math.max(mean - root2, 0))];
    const points = Array.from({ length: 41 }, (_, i) => [a * Math.cos(i * Math.PI / 20), b * Math.sin(i * Math.PI / 20)]);
    const [c, s] = [Math.cos(angle), Math.sin(angle)];
    return { x: points.map(([u, v]) => x + c * u - s * v), y: points.map(([u, v]) => y + s * u + c * v) };
  }
  const minus = (a, b) => a.map((x, i) => (x === null || b[i] === null ? null : x - b[i]));
  const upTo = (values, n) => values.slice(0, n + 1);
  function extent(rows, share = 0.05) {
    const all = rows.flat().filter((x) => x !== null);
    const [low, high] = all.reduce(([l, h], x) => [Math.min(l, x), Math.max(h, x)], [Infinity, -Infinity]);
    const margin = (high - low || 1) * share;
    return [low - margin, high + margin];
  }

  // Time of the largest error.
  function worstTime(track, name) {
    if (!track.has("truth")) return 0;
    const at = track.words("policy").indexOf(name);
    const errors = track.words("component").map((_, i) => minus(track.row("estimate", at, i), track.row("truth", at, i)));
    const sizes = track.time.map((_, n) => errors.reduce((sum, error) => sum + (error[n] || 0) ** 2, 0));
    return sizes.indexOf(Math.max(...sizes));
  }

  function drawTrack(figure, cell, begin = Math.floor(cell.track.time.length / 2)) {
    const { track, lines } = cell;
    const names = track.words("policy"), components = track.words("component"), units = track.words("unit");
    const plane = Number(track.attrs.get("plane")) === 1, time = track.time;
    const shown = lines.filter((line) => names.includes(line.name) && !isGrey(line));
    const box = figure.querySelector(".plot");
    const panels = box.appendChild(Object.assign(document.createElement("div"), { className: "panels" }));
    const [left, right] = [0, 1].map(() => panels.appendChild(document.createElement("div")));
    const slider = Object.assign(document.createElement("input"), { type: "range", min: 0, max: time.length - 1, value: begin, step: 1 });
    slider.setAttribute("aria-label", "time");
    const output = document.createElement("output");
    const bar = box.appendChild(Object.assign(document.createElement("div"), { className: "slider" }));
    bar.append(slider, output);
    let component = 0;
    if (!plane && components.length > 1) addChoices(figure, components.map(words), (i) => { component = i; draw(); });
    const state = (line, i) => track.row("estimate", names.indexOf(line.name), i);
    const truth = (line, i) => track.has("truth") ? track.row("truth", names.indexOf(line.name), i) : state(line, i).map(() => null);
    const seen = (i) => track.has("seen") ? track.row("seen", 0, i) : [];
    const sigma = (line, i) => track.row("sigma", names.indexOf(line.name), i);
    const marks = { color: css("--soft"), size: 5, symbol: "cross-thin-open" };

    function drawPlane(n) {
      const first = shown[0], [tx, ty] = [truth(first, 0), truth(first, 1)], [sx, sy] = [seen(0), seen(1)];
      const path = (x, y, more) => ({ x, y, mode: "lines", ...more });
      const overview = [
        path(tx, ty, { name: "truth", line: { color: css("--soft"), width: 5 }, opacity: 0.45 }),
        { x: upTo(sx, n), y: upTo(sy, n), mode: "markers", name: "measured", marker: marks },
        ...shown.map((line) => path(upTo(state(line, 0), n), upTo(state(line, 1), n), { name: plain(line.name), line: look(line) })),
      ];
      const title = (i) => ({ title: { text: `${words(components[i])}, ${plain(units[i])}` } });
      const rangeX = extent([tx, ...shown.map((line) => state(line, 0))]), rangeY = extent([ty, ...shown.map((line) => state(line, 1))]);
      Plotly.react(left, overview, layout({ xaxis: { ...title(0), range: rangeX }, yaxis: { ...title(1), range: rangeY, scaleanchor: "x", constrain: "domain" }, uirevision: "track" }), config);
      // A close-up around the truth with the current errors and ellipses.
      const close = [{ x: [0], y: [0], mode: "markers", name: "truth", marker: { color: css("--fg"), size: 9, symbol: "x-thin-open" }, showlegend: false }];
      if (sx.length && sx[n] !== null && tx[n] !== null) close.push({ x: [sx[n] - tx[n]], y: [sy[n] - ty[n]], mode: "markers", name: "measured", marker: { ...marks, size: 10 }, showlegend: false });
      let reach = 0;
      for (const line of shown) {
        const [x, y] = [minus(state(line, 0), truth(line, 0)), minus(state(line, 1), truth(line, 1))];
        if (x[n] === null) continue;
        const [u, v, r] = [sigma(line, 0)[n], sigma(line, 1)[n], track.row("correlation", names.indexOf(line.name))[n]];
        const around = ellipse(x[n], y[n], u * u, r * u * v, v * v), style = look(line), group = { legendgroup: plain(line.name), showlegend: false, name: plain(line.name) };
        const errors = x.map((u, i) => Math.hypot(u, y[i])).filter(Number.isFinite).sort((a, b) => a - b);
        reach = Math.max(reach, errors[Math.floor(0.9 * (errors.length - 1))] || 0, 2 * Math.max(u, v) / 1.5);
        if (line === first) reach = Math.max(reach, Math.hypot(x[n], y[n])); // the subject of the picture stays inside
        close.push(path(x.slice(Math.max(0, n - 12), n + 1), y.slice(Math.max(0, n - 12), n + 1), { line: { ...style, width: 1 }, opacity: 0.5, hoverinfo: "skip", ...group }),
          path(around.x, around.y, { line: style, hoverinfo: "skip", ...group }),
          { x: [x[n]], y: [y[n]], mode: "markers", marker: { color: style.color, size: 8 }, ...group });
      }
      const range = [-1.3 * reach || -1, 1.3 * reach || 1];
      Plotly.react(right, close, layout({ xaxis: { title: { text: `error of ${words(components[0])}, ${plain(units[0])}` }, range, constrain: "domain" }, yaxis: { title: { text: `error of ${words(components[1])}, ${plain(units[1])}` }, range, scaleanchor: "x", constrain: "domain" } }), config);
    }

    function drawLine(n) {
      const i = component, closed = shown.some((line) => JSON.stringify(truth(line, i)) !== JSON.stringify(truth(shown[0], i)));
      const values = [], errors = [];
      if (!closed && something(truth(shown[0], i))) values.push({ x: time, y: truth(shown[0], i), mode: "lines", name: "truth", line: { color: css("--soft"), width: 5 }, opacity: 0.45 });
      if (!closed && seen(i).length && something(seen(i))) values.push({ x: upTo(time, n), y: upTo(seen(i), n), mode: "markers", name: "measured", marker: marks });
      for (const line of shown) {
        const style = look(line), group = { legendgroup: plain(line.name), name: plain(line.name) };
        values.push({ x: upTo(time, n), y: upTo(state(line, i), n), mode: "lines", line: style, ...group });
        const error = minus(state(line, i), truth(line, i)), two = sigma(line, i).map((v) => (v === null ? null : 2 * v));
        if (!something(error)) continue;
        const edge = { x: upTo(time, n), mode: "lines", line: { width: 0.7, color: style.color, dash: "dot" }, hoverinfo: "skip", showlegend: false, ...group };
        errors.push({ ...edge, y: upTo(two, n) }, { ...edge, y: upTo(two.map((v) => v === null ? null : -v), n) }, { x: upTo(time, n), y: upTo(error, n), mode: "lines", line: style, ...group, showlegend: false });
      }
      const unit = plain(units[i]), axis = { title: { text: track.clock }, range: extent([time], 0.02) };
      const everything = shown.map((line) => state(line, i));
      Plotly.react(left, values, layout({ xaxis: axis, yaxis: { title: { text: `${words(components[i])}, ${unit}` }, range: extent([...everything, seen(i)]) } }), config);
      const sizes = shown.flatMap((line) => minus(state(line, i), truth(line, i))).filter((x) => x !== null).map(Math.abs).sort((a, b) => a - b);
      const own = minus(state(shown[0], i), truth(shown[0], i)).filter((x) => x !== null).map(Math.abs);
      const reach = 1.2 * Math.max(sizes[Math.floor(0.98 * (sizes.length - 1))] || 1, ...own);
      Plotly.react(right, errors, layout({ xaxis: axis, yaxis: { title: { text: `error of ${words(components[i])}, ${unit}; dotted: two sigma` }, range: [-reach, reach] } }), config);
    }

    function draw() {
      const n = Number(slider.value);
      output.textContent = `${track.has("elapsed") ? `${time[n]} s, ` : ""}measurement ${track.numbers("time")[n]}`;
      (plane ? drawPlane : drawLine)(n);
    }
    let asked = false;
    slider.addEventListener("input", () => { if (!asked) { asked = true; requestAnimationFrame(() => { asked = false; draw(); }); } });
    draw();
    return draw;
  }

  // --- pages: choices, drawing, themes, sorting

  function addChoices(figure, names, chosen) {
    const box = figure.querySelector(".choices"), select = document.createElement("select");
    select.setAttribute("aria-label", "what is shown");
    names.forEach((name, i) => select.append(new Option(name.replace(/&lt;/g, "<").replace(/&gt;/g, ">").replace(/&amp;/g, "&"), i)));
    select.addEventListener("change", () => chosen(Number(select.value)));
    box.append(select);
  }

  // One of the worst episodes at a time, with its two competitors in colour.
  function drawWorst(figure, cell) {
    const box = figure.querySelector(".plot");
    let draw = () => {};
    const show = (i) => {
      const { policy, opponent, track } = cell.worst[i];
      const inner = Object.assign(document.createElement("div"), { className: "inner" });
      inner.append(...["choices", "plot"].map((className) => Object.assign(document.createElement("div"), { className })));
      box.replaceChildren(inner);
      const known = (name) => cell.lines.find((line) => line.name === name) || { name, origin: "classical", colour: null };
      const lines = [policy, opponent].filter((name) => name).map(known).map((line, i) => isGrey(line) ? { ...line, colour: i } : line);
      const data = new Data(track);
      draw = drawTrack(inner, { lines, track: data }, worstTime(data, policy));
    };
    addChoices(figure, cell.worst.map(({ policy, seed, cost }) => `${policy}, episode ${seed}, mean cost ${cost}`), show);
    show(0);
    return () => draw();
  }

  function drawFigure(figure, cell) {
    const kind = figure.dataset.kind, box = figure.querySelector(".plot");
    if (kind === "worst") return redraw.push(drawWorst(figure, cell));
    if (kind === "track") return redraw.push(drawTrack(figure, cell));
    const choices = kind === "dots" ? [["", () => dotted(cell.scenarios, cell.lines, cell.paper)]] : FIGURES[kind](cell);
    let current = 0;
    const draw = () => { const [drawn, laid] = choices[current][1](); return Plotly.react(box, drawn, laid, config); };
    if (choices.length > 1) addChoices(figure, choices.map(([name]) => name), (i) => { current = i; draw(); });
    if (!choices.length) return figure.remove();
    draw();
    return redraw.push(draw);
  }

  async function open(details) {
    if (details.dataset.drawn) return;
    details.dataset.drawn = "begun";
    await library;
    const cell = await unpacked(details.querySelector(":scope > script.data")).json();
    cell.curves = cell.curves && new Data(cell.curves);
    cell.track = cell.track && new Data(cell.track);
    for (const figure of details.querySelectorAll("figure")) {
      try { drawFigure(figure, cell); } catch (error) { figure.querySelector(".plot").textContent = `This figure cannot be drawn: ${error.message}`; console.error(error); }
    }
    details.dataset.drawn = "done";
  }
  for (const details of document.querySelectorAll("details.cell")) details.addEventListener("toggle", () => details.open && open(details));
  const wide = new IntersectionObserver((seen) => seen.filter((entry) => entry.isIntersecting).forEach(async ({ target }) => {
    wide.unobserve(target);
    await library;
    drawFigure(target, await unpacked(target.querySelector("script.data")).json());
    target.dataset.drawn = "done";
  }), { rootMargin: "300px" });
  for (const figure of document.querySelectorAll("figure[data-kind=dots]")) wide.observe(figure);
  const start = document.querySelector("details[data-start]");
  if (start) start.open = true;
  const linked = location.hash && document.getElementById(location.hash.slice(1));
  if (linked && linked.matches("details.cell")) linked.open = true;

  // A table that is wider than its place is marked.
  const places = new ResizeObserver((seen) => seen.forEach(({ target }) => target.classList.toggle("scrolls", target.scrollWidth > target.clientWidth + 1)));
  for (const place of document.querySelectorAll(".table")) places.observe(place);

  for (const table of document.querySelectorAll("table.sortable")) {
    table.tHead.addEventListener("click", (event) => {
      const head = event.target.closest("th");
      if (!head) return;
      const descending = head.getAttribute("aria-sort") === "ascending", column = head.cellIndex;
      for (const other of head.parentNode.cells) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", descending ? "descending" : "ascending");
      const number = head.classList.contains("number");
      const value = (row) => row.cells[column].dataset.sort;
      const order = (a, b) => {
        const [u, v] = [value(a), value(b)];
        if (u === undefined || v === undefined) return (u === undefined) - (v === undefined); // missing values last
        const less = number && !Number.isNaN(Number(u)) && !Number.isNaN(Number(v)) ? Number(u) - Number(v) : u.localeCompare(v);
        return descending ? -less : less;
      };
      table.tBodies[0].append(...[...table.tBodies[0].rows].sort(order));
    });
  }

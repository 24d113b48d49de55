// Common parts of all pages: packed data, style of figures, and light or dark. All names in the data are text:
// `plain` prevents Plotly from reading marks in them.
  const COLOURS = ["#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"]; // Okabe and Ito
  const OWN = "#9B5DE5"; // of the user's competitors
  const plain = (text) => String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");
  const words = (text) => plain(text).replace(/_/g, " ");
  const root = document.documentElement;
  const css = (name) => getComputedStyle(root).getPropertyValue(name).trim();

  function unpacked(script) {
    const bytes = Uint8Array.from(atob(script.textContent.trim()), (c) => c.charCodeAt(0));
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip")));
  }
  // Plotly is in the page once, packed; the page's policy allows it by its hash.
  const library = unpacked(document.getElementById("plotly")).text().then((text) => {
    document.head.append(Object.assign(document.createElement("script"), { textContent: text }));
  });

  // --- style of figures

  function layout(changes) {
    const axis = { gridcolor: css("--line"), zerolinecolor: css("--soft"), linecolor: css("--line"), automargin: true };
    const narrow = window.innerWidth < 640;
    const { xaxis, yaxis, ...others } = changes;
    return {
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { family: "system-ui, sans-serif", size: narrow ? 11 : 12, color: css("--fg") },
      margin: { l: narrow ? 45 : 60, r: 10, t: 30, b: 45 }, height: narrow ? 430 : 440,
      hoverlabel: { namelength: -1 },
      modebar: { bgcolor: "rgba(0,0,0,0)", color: css("--soft"), activecolor: css("--fg") },
      legend: { orientation: "h", y: -0.22, yanchor: "top", itemclick: "toggleothers", itemdoubleclick: "toggle", groupclick: "togglegroup" },
      xaxis: { ...axis, ...xaxis }, yaxis: { ...axis, ...yaxis }, ...others,
    };
  }
  const config = { displayModeBar: window.innerWidth < 640 ? false : "hover", responsive: true, displaylogo: false, modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"], toImageButtonOptions: { format: "svg" } };

  // --- themes; visible figures are drawn again

  const redraw = [];
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const again = () => redraw.forEach((draw) => draw());
  dark.addEventListener("change", again);
  document.getElementById("theme").addEventListener("click", () => {
    const now = root.dataset.theme || (dark.matches ? "dark" : "light");
    root.dataset.theme = now === "dark" ? "light" : "dark";
    again();
  });

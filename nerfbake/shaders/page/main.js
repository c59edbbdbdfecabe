// Start the viewer, or explain why the page cannot be shown.

// The facts of the page; null if the page is cut off before their end.
function readFacts() {
  try {
    return JSON.parse(element("facts").textContent);
  } catch {
    return null;
  }
}

document.addEventListener("DOMContentLoaded", () => {
  const facts = readFacts(), data = element("data")?.textContent ?? "", count = (size) => size.toLocaleString("en");
  if (data.length !== facts?.length) {
    const there = facts ? `${count(data.length)} of ${count(facts.length)} characters of its data are there` : "its end is missing";
    element("status").textContent = `This page is not complete: ${there}. What you see is a still picture.`;
    return;
  }
  const viewer = new Viewer(facts, element("shader").textContent, data);
  for (const name of ["shader", "facts", "data"]) element(name).remove();
  /** @type {any} */ (window).nerfbake = viewer; // for scripts and the browser's console
  viewer.start();
});
element("status").textContent = "Opening";

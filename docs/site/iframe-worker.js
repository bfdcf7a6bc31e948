// Runs the search in a frame where a page is opened as a file, because browsers start no workers there.
if (location.protocol === "file:") {
  window.Worker = window.IFrameWorker = class extends EventTarget {
    constructor(url) {
      super()
      const frame = document.createElement("iframe")
      frame.hidden = true
      document.body.append(frame)
      const inside = frame.contentWindow
      inside.importScripts = (...urls) => Promise.all(urls.flat().map(each => load(inside.document, each)))
      // What the worker sends goes to the page; what the page sends, to the worker.
      inside.postMessage = data => this.dispatchEvent(new MessageEvent("message", { data }))
      this.postMessage = data => this.ready.then(() => inside.dispatchEvent(new MessageEvent("message", { data })))
      this.ready = load(inside.document, url)
    }

    terminate() {}

    set onmessage(handler) {
      this.addEventListener("message", handler)
    }
  }

  function load(document, url) {
    return new Promise((resolve, reject) => {
      const script = document.createElement("script")
      script.src = url
      script.onload = resolve
      script.onerror = reject
      document.body.append(script)
    })
  }
}

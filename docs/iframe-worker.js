// Search in a site that is opened from disk. Browsers refuse workers there, so the search's script runs in a hidden
// frame behind the interface of a Worker. The plugin "offline" would load such a script from the network.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.waiting = [];
      this.frame = document.createElement("iframe");
      this.frame.hidden = true;
      this.frame.worker = this;
      this.frame.srcdoc =
        `<script>
           const { worker } = frameElement;
           postMessage = data => worker.dispatchEvent(new parent.MessageEvent("message", { data }));
         </script>
         <script src="${new URL(url, location.href)}"></script>`;
      this.frame.onload = () => {
        const waiting = this.waiting;
        this.waiting = null;
        waiting.forEach(data => this.postMessage(data));
      };
      document.body.append(this.frame);
    }

    postMessage(data) {
      const { contentWindow } = this.frame;
      if (this.waiting) this.waiting.push(data);
      else contentWindow.dispatchEvent(new contentWindow.MessageEvent("message", { data }));
    }

    terminate() {
      this.frame.remove();
    }
  };
}

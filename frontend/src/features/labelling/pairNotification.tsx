import { useEffect, useRef, useState } from "react";

/** In the browser's storage: "yes" once the user has asked for notifications. */
const KEY = "accord.notify-of-pairs";

const isSupported = (): boolean => "Notification" in window;
const isOn = (): boolean =>
  isSupported() && Notification.permission === "granted" && localStorage.getItem(KEY) === "yes";

/** Notifies a user who asked for it, and who looks at another page, that there are pairs to label again. */
export function usePairNotification(experimentName: string, hasPair: boolean): void {
  const waited = useRef(false);
  useEffect(() => {
    if (!hasPair) {
      waited.current = true;
      return;
    }
    if (waited.current && document.hidden && isOn()) {
      const notification = new Notification("Pairs are ready to label", {
        body: experimentName,
        tag: `pairs of ${experimentName}`,
      });
      notification.onclick = () => {
        window.focus();
        notification.close();
      };
    }
    waited.current = false;
  }, [hasPair, experimentName]);
}

/** The switch for notifications; asks for the browser's permission when it is turned on. */
export function PairNotificationSwitch() {
  const [on, setOn] = useState(isOn);
  const [denied, setDenied] = useState(false);
  if (!isSupported()) return null;
  const change = async (wanted: boolean) => {
    const granted = wanted && (await Notification.requestPermission()) === "granted";
    localStorage.setItem(KEY, granted ? "yes" : "no");
    setOn(granted);
    setDenied(wanted && !granted);
  };
  return (
    <p>
      <label>
        <input type="checkbox" checked={on} onChange={(event) => void change(event.target.checked)} /> Notify
        me when pairs are ready
      </label>
      {denied && <span className="muted"> This browser blocks notifications from this page.</span>}
    </p>
  );
}

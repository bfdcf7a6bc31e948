import { useEffect, useRef, useState } from "react";
import { errorMessage } from "@/shared/api/errors";
import { receiveFile } from "@/shared/api/transfer";
import { download } from "@/shared/charts/download";
import { ProgressBar } from "@/shared/ui/ProgressBar";

type Progress =
  | { state: "idle" | "writing" | "failed"; error?: string }
  | { state: "loading"; share: number };

/** Downloads the segments, queries and labels of an experiment, and shows how far it is. */
export function ExportButton({ experimentId }: { experimentId: string }) {
  const [progress, setProgress] = useState<Progress>({ state: "idle" });
  const running = useRef<AbortController>(null);
  useEffect(() => () => running.current?.abort(), []);
  const start = async () => {
    const abort = new AbortController();
    running.current = abort;
    setProgress({ state: "writing" });
    try {
      const file = await receiveFile(
        `/api/v1/experiments/${experimentId}/export`,
        (share) => setProgress({ state: "loading", share }),
        abort.signal,
      );
      download(file, `${experimentId}.zip`, file.type);
      setProgress({ state: "idle" });
    } catch (error) {
      setProgress(abort.signal.aborted ? { state: "idle" } : { state: "failed", error: errorMessage(error) });
    }
  };
  if (progress.state === "writing" || progress.state === "loading") {
    const share = progress.state === "loading" ? progress.share : 0;
    return (
      <div className="export-line" role="status">
        <ProgressBar
          label="Export"
          value={Math.round(100 * share)}
          max={100}
          text={
            progress.state === "writing" ? "the server writes the tables…" : `${Math.round(100 * share)}%`
          }
        />
        <button type="button" className="button small" onClick={() => running.current?.abort()}>
          Cancel
        </button>
      </div>
    );
  }
  return (
    <p className="export-line">
      <button type="button" className="button" onClick={() => void start()}>
        Export
      </button>{" "}
      <span className="muted">segments, queries and labels as Parquet tables, zipped.</span>
      {progress.error && (
        <span className="alert" role="alert">
          {progress.error}
        </span>
      )}
    </p>
  );
}

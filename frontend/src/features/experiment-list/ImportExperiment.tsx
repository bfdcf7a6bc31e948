import { useQueryClient } from "@tanstack/react-query";
import { type FormEvent, useEffect, useRef, useState } from "react";
import { errorMessage } from "@/shared/api/errors";
import { experimentsKey } from "@/shared/api/queries";
import { sendFile } from "@/shared/api/transfer";
import type { Experiment } from "@/shared/api/types";
import { paths } from "@/shared/routing/paths";
import { navigate } from "@/shared/routing/router";
import { Alert } from "@/shared/ui/Message";
import { ProgressBar } from "@/shared/ui/ProgressBar";

/** A form that creates a paused experiment from an exported one. */
export function ImportExperiment({ onClose }: { onClose: () => void }) {
  const [name, setName] = useState("");
  const [file, setFile] = useState<File | null>(null);
  /** the share of the file that was sent; null while nothing is */
  const [sent, setSent] = useState<number | null>(null);
  const [error, setError] = useState<string | null>(null);
  const running = useRef<AbortController>(null);
  const cache = useQueryClient();
  useEffect(() => () => running.current?.abort(), []);
  const submit = async (event: FormEvent) => {
    event.preventDefault();
    if (!file) return;
    const abort = new AbortController();
    running.current = abort;
    setError(null);
    setSent(0);
    try {
      const path = `/api/v1/experiments/import?name=${encodeURIComponent(name)}`;
      const created = await sendFile<Experiment>(path, file, setSent, abort.signal);
      void cache.invalidateQueries({ queryKey: experimentsKey });
      navigate(paths.experiment(created.id));
    } catch (failure) {
      if (!abort.signal.aborted) setError(errorMessage(failure));
      setSent(null);
    }
  };
  const close = () => {
    running.current?.abort();
    onClose();
  };
  return (
    <form
      className="card import-form"
      aria-labelledby="import-title"
      onSubmit={(event) => void submit(event)}
    >
      <h2 id="import-title">Import an experiment</h2>
      <p className="muted">
        Choose the ZIP file of an export. The new experiment begins with its settings, segments and labels,
        and is paused until you resume it.
      </p>
      {error && <Alert>{error} Nothing was imported.</Alert>}
      <label>
        Export{" "}
        <input
          type="file"
          accept=".zip,application/zip"
          required
          disabled={sent !== null}
          onChange={(event) => setFile(event.target.files?.[0] ?? null)}
        />
      </label>
      <label>
        Name of the new experiment{" "}
        <input
          type="text"
          required
          maxLength={200}
          value={name}
          disabled={sent !== null}
          onChange={(event) => setName(event.target.value)}
        />
      </label>
      {sent !== null && (
        <div role="status">
          <ProgressBar
            label="Upload"
            value={Math.round(100 * sent)}
            max={100}
            text={sent < 1 ? `${Math.round(100 * sent)}%` : "uploaded; the server stores the segments…"}
          />
        </div>
      )}
      <div className="row">
        <button type="submit" className="button primary" disabled={sent !== null}>
          Import
        </button>
        <button type="button" className="button" onClick={close}>
          Cancel
        </button>
      </div>
    </form>
  );
}

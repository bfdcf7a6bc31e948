import { QueryCache, QueryClient, QueryClientProvider, useQuery } from "@tanstack/react-query";
import { SignedOut } from "@/features/session/SignedOut";
import { ApiError, errorMessage } from "@/shared/api/errors";
import { meQuery, shouldRetry } from "@/shared/api/queries";
import { OutboxProvider } from "@/shared/outbox/OutboxProvider";
import { Message } from "@/shared/ui/Message";
import { Layout } from "./Layout";
import { Routes } from "./Routes";

const RECONNECT_MS = 2_000;

const cache = new QueryClient({
  defaultOptions: { queries: { retry: shouldRetry, staleTime: 1_000 } },
  queryCache: new QueryCache({
    // Any request can be the first to find that the session expired: reload the user, which shows the sign-in page.
    onError: (error, query) => {
      if (error instanceof ApiError && error.status === 401 && query.queryKey[0] !== "me") {
        void cache.resetQueries({ queryKey: meQuery.queryKey });
      }
    },
  }),
});

export function App() {
  return (
    <QueryClientProvider client={cache}>
      <Session />
    </QueryClientProvider>
  );
}

/** The app for a signed-in user, or the sign-in page. */
function Session() {
  const me = useQuery({ ...meQuery, refetchInterval: (query) => (query.state.error ? RECONNECT_MS : false) });
  // Checked before `data`: the cache still holds the user after the session expired.
  if (me.error instanceof ApiError && me.error.status === 401) return <SignedOut />;
  if (me.data) {
    return (
      <OutboxProvider userId={me.data.id}>
        <Layout me={me.data}>
          <Routes me={me.data} />
        </Layout>
      </OutboxProvider>
    );
  }
  if (me.error) {
    return (
      <Message title="Cannot reach Accord">
        <p>{errorMessage(me.error)} This page reconnects automatically.</p>
      </Message>
    );
  }
  return null;
}

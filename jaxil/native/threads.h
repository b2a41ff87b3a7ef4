/* Parallel work on XLA's thread pool. */

#ifndef JAXIL_THREADS_H
#define JAXIL_THREADS_H

#include <sched.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdlib.h>

#include "xla/ffi/api/c_api.h"

/* Processes one part of a call. Each thread has its own scratch, which stays in its
   cache from one part to the next. */
typedef void Work(void *call, size_t part, float *scratch);

/* Hands out the parts of a batch one by one. The last user frees it. */
typedef struct {
  Work *work;
  void *call;
  size_t count, scratch_size;
  atomic_size_t next, done, users;
  atomic_int out_of_memory;
} Team;

static void leave(Team *team) {
  if (atomic_fetch_sub(&team->users, 1) == 1) free(team);
}

/* Processes parts until none are left. */
static void work_on(Team *team) {
  float *scratch = NULL;
  size_t part;
  while ((part = atomic_fetch_add(&team->next, 1)) < team->count) {
    if (scratch == NULL) scratch = malloc((team->scratch_size + 1) * sizeof(float));
    if (scratch == NULL)
      atomic_store(&team->out_of_memory, 1);
    else
      team->work(team->call, part, scratch);
    atomic_fetch_add(&team->done, 1);
  }
  free(scratch);
}

static void take_part(void *data) {
  work_on(data);
  leave(data);
}

/* Returns whether a call of XLA succeeded; frees its error. */
static int succeeded(XLA_FFI_CallFrame *frame, XLA_FFI_Error *error) {
  if (error == NULL) return 1;
  XLA_FFI_Error_Destroy_Args args = {
      .struct_size = XLA_FFI_Error_Destroy_Args_STRUCT_SIZE,
      .error = error,
  };
  frame->api->XLA_FFI_Error_Destroy(&args);
  return 0;
}

/* Returns the number of XLA's threads; 1 if unknown. */
static size_t number_of_threads(XLA_FFI_CallFrame *frame) {
  int64_t threads = 1;
  XLA_FFI_ThreadPool_NumThreads_Args args = {
      .struct_size = XLA_FFI_ThreadPool_NumThreads_Args_STRUCT_SIZE,
      .ctx = frame->ctx,
      .num_threads = &threads,
  };
  const int known = succeeded(frame, frame->api->XLA_FFI_ThreadPool_NumThreads(&args));
  return known && threads > 1 ? (size_t)threads : 1;
}

/* Processes all parts on XLA's free threads and this one. A thread that starts late
   finds nothing left, so this only waits for parts in progress and cannot deadlock.
   Returns 0 if a scratch of `scratch_size` floats could not be allocated. */
static int for_each(size_t count, XLA_FFI_CallFrame *frame, Work *work, void *call,
                    size_t scratch_size) {
  if (count == 0) return 1;
  Team *team = malloc(sizeof(Team));
  if (team == NULL) return 0;
  *team =
      (Team){.work = work, .call = call, .count = count, .scratch_size = scratch_size};
  const size_t threads = number_of_threads(frame);
  const size_t members = threads < count ? threads : count;
  atomic_init(&team->users, members);
  for (size_t k = 1; k < members; k++) {
    XLA_FFI_ThreadPool_Schedule_Args task = {
        .struct_size = XLA_FFI_ThreadPool_Schedule_Args_STRUCT_SIZE,
        .ctx = frame->ctx,
        .task = take_part,
        .data = team,
    };
    if (!succeeded(frame, frame->api->XLA_FFI_ThreadPool_Schedule(&task))) leave(team);
  }
  work_on(team);
  while (atomic_load(&team->done) < count) sched_yield();
  const int allocated = !atomic_load(&team->out_of_memory);
  leave(team);
  return allocated;
}

#endif

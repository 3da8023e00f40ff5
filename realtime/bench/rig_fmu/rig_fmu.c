/* The rig as an FMU of FMI 3.0 for co-simulation: this library, and a process that computes.

The library starts Python with rollerrig as a separate process and talks to it over a socket. So the
importing tool needs no Python of its own, nothing of Python is loaded into it, and nothing that
happens in the process can crash it. Each refusal is fmi3Error, with a sentence for the logger.

Which Python: the variable ROLLERRIG_PYTHON, else the one that has written the FMU (python.txt in the
resources), else python3 on the path.

A request is: length of what follows (uint32), one byte for the kind, content. An answer is: length
(uint32), one byte (0: done, 1: refused), content, which is a sentence if the request was refused.
All numbers have the byte order of the machine. `server.py` is the other side. */

#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <spawn.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/wait.h>
#include <unistd.h>

#include "fmi3Functions.h"
#include "token.h" /* INSTANTIATION_TOKEN */

#define TEXT_BYTES 4096
#define LAST_WORDS_BYTES 1500
#define MOST_BYTES (1u << 20) /* of a message */

extern char **environ;

typedef enum { INSTANTIATED, INITIALIZING, STEPPING, TERMINATED, FAILED } State;

typedef struct {
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
    State state;
    pid_t process;  /* 0: it has been waited for */
    int socket;     /* -1: there is no process */
    FILE *output;   /* of the process: its last words are part of messages */
    double time_s;
} Rig;

/* -- messages */

static void vlog_error(fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                       const char *format, va_list values) {
    char text[TEXT_BYTES];
    vsnprintf(text, sizeof text, format, values);
    if (log)
        log(environment, fmi3Error, "logStatusError", text);
    else
        fprintf(stderr, "rollerrig: %s\n", text);
}

/* Reports a sentence, and returns the status of a refused call. */
static fmi3Status refuse(const Rig *rig, const char *format, ...) {
    va_list values;
    va_start(values, format);
    vlog_error(rig->environment, rig->log, format, values);
    va_end(values);
    return fmi3Error;
}

fmi3Status rig_unsupported(void *instance, const char *function) {
    if (instance) refuse(instance, "%s: this FMU does not have what the function needs", function);
    return fmi3Error;
}

/* Writes the last output of the process into a text; empty if there is none. */
static void last_words(const Rig *rig, char text[LAST_WORDS_BYTES + 1]) {
    text[0] = '\0';
    if (!rig->output) return;
    int file = fileno(rig->output);
    off_t end = lseek(file, 0, SEEK_END);
    off_t begin = end > LAST_WORDS_BYTES ? end - LAST_WORDS_BYTES : 0;
    ssize_t count = pread(file, text, LAST_WORDS_BYTES, begin);
    text[count > 0 ? count : 0] = '\0';
}

/* -- the process */

static int send_all(int socket, const void *data, size_t size) {
    const char *next = data;
    while (size) {
        /* without MSG_NOSIGNAL a process that has died would end the importing tool */
        ssize_t sent = send(socket, next, size, MSG_NOSIGNAL);
        if (sent < 0 && errno == EINTR) continue;
        if (sent <= 0) return 0;
        next += sent;
        size -= (size_t)sent;
    }
    return 1;
}

static int receive_all(int socket, void *data, size_t size) {
    char *next = data;
    while (size) {
        ssize_t received = recv(socket, next, size, 0);
        if (received < 0 && errno == EINTR) continue;
        if (received <= 0) return 0;
        next += received;
        size -= (size_t)received;
    }
    return 1;
}

/* Closes the connection and waits for the process, which exits when its connection is closed. */
static void end_process(Rig *rig, char reason[128]) {
    if (rig->socket >= 0) close(rig->socket);
    rig->socket = -1;
    if (reason) snprintf(reason, 128, "it has ended");
    if (rig->process <= 0) return;
    int status = 0;
    pid_t ended;
    do {
        ended = waitpid(rig->process, &status, 0);
    } while (ended < 0 && errno == EINTR);
    rig->process = 0;
    if (!reason || ended < 0) return;
    if (WIFSIGNALED(status))
        snprintf(reason, 128, "it was ended by signal %d", WTERMSIG(status));
    else
        snprintf(reason, 128, "it has exited with status %d", WEXITSTATUS(status));
}

/* Reports that the process is gone, with its last words. */
static fmi3Status lost(Rig *rig) {
    char reason[128];
    char words[LAST_WORDS_BYTES + 1];
    end_process(rig, reason);
    last_words(rig, words);
    rig->state = FAILED;
    return refuse(rig,
                  "the process of the rig is gone: %s; its last output: %s; instantiate the FMU "
                  "again. If rollerrig is not installed in that Python, name one that has it in "
                  "the variable ROLLERRIG_PYTHON",
                  reason, words[0] ? words : "none");
}

/* Receives an answer of `size` bytes. A refusal is reported. */
static fmi3Status answer(Rig *rig, void *content, size_t size) {
    uint32_t length = 0;
    unsigned char refused = 0;
    if (!receive_all(rig->socket, &length, sizeof length) || length < 1 || length > MOST_BYTES ||
        !receive_all(rig->socket, &refused, 1))
        return lost(rig);
    length -= 1;
    if (!refused && length == size)
        return receive_all(rig->socket, content, size) ? fmi3OK : lost(rig);

    char *text = calloc(length + 1, 1);
    if (!text || !receive_all(rig->socket, text, length)) {
        free(text);
        return lost(rig);
    }
    fmi3Status status = refuse(rig, "%s", refused ? text : "the process has answered wrongly");
    free(text);
    return status;
}

/* Sends a request whose content is in two pieces, and receives its answer. */
static fmi3Status request(Rig *rig, char kind, const void *first, size_t first_size,
                          const void *second, size_t second_size, void *content, size_t size) {
    if (rig->socket < 0) return refuse(rig, "the process of the rig is gone; instantiate again");
    uint32_t length = (uint32_t)(1 + first_size + second_size);
    if (length > MOST_BYTES) return refuse(rig, "more values than this FMU has variables");
    if (!send_all(rig->socket, &length, sizeof length) || !send_all(rig->socket, &kind, 1) ||
        !send_all(rig->socket, first, first_size) || !send_all(rig->socket, second, second_size))
        return lost(rig);
    return answer(rig, content, size);
}

/* Reads the first line of a file in the resources; returns whether there is one. */
static int read_line(const char *folder, const char *name, char *line, size_t size) {
    char path[TEXT_BYTES];
    size_t length = strlen(folder);
    const char *separator = length && folder[length - 1] == '/' ? "" : "/";
    snprintf(path, sizeof path, "%s%s%s", folder, separator, name);
    FILE *file = fopen(path, "re");
    if (!file) return 0;
    int found = fgets(line, (int)size, file) != NULL;
    fclose(file);
    line[found ? strcspn(line, "\n") : 0] = '\0';
    return found;
}

/* Starts a program as the process of a rig; returns an error number of the system, 0 for none. */
static int start(Rig *rig, const char *program, const char *resources) {
    int ends[2];
    if (socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, ends) < 0) return errno;
    int output = rig->output ? fileno(rig->output) : STDERR_FILENO;
    char *words[] = {(char *)program, "-P", "-m", "rollerrig.realtime.bench.rig_fmu.server",
                     (char *)resources, NULL};
    posix_spawn_file_actions_t actions;
    posix_spawn_file_actions_init(&actions);
    posix_spawn_file_actions_adddup2(&actions, ends[1], STDIN_FILENO);
    posix_spawn_file_actions_adddup2(&actions, output, STDOUT_FILENO);
    posix_spawn_file_actions_adddup2(&actions, output, STDERR_FILENO);
    int error = posix_spawnp(&rig->process, program, &actions, NULL, words, environ);
    posix_spawn_file_actions_destroy(&actions);
    close(ends[1]);
    if (error) {
        close(ends[0]);
        rig->process = 0;
        return error;
    }
    rig->socket = ends[0];
    return 0;
}

static void free_rig(Rig *rig) {
    end_process(rig, NULL);
    if (rig->output) fclose(rig->output);
    free(rig);
}

/* -- creation */

fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
    fmi3Boolean visible, fmi3Boolean loggingOn, fmi3Boolean eventModeUsed,
    fmi3Boolean earlyReturnAllowed, const fmi3ValueReference requiredIntermediateVariables[],
    size_t nRequiredIntermediateVariables, fmi3InstanceEnvironment instanceEnvironment,
    fmi3LogMessageCallback logMessage, fmi3IntermediateUpdateCallback intermediateUpdate) {
    Rig *rig = calloc(1, sizeof *rig);
    if (!rig) return NULL;
    rig->environment = instanceEnvironment;
    rig->log = logMessage;
    rig->socket = -1;

    const char *wrong = NULL;
    if (!instantiationToken || strcmp(instantiationToken, INSTANTIATION_TOKEN))
        wrong = "the instantiation token is not that of this FMU; read it from modelDescription.xml";
    else if (!resourcePath)
        wrong = "the path of the resources is missing; give the folder resources of the FMU";
    else if (eventModeUsed)
        wrong = "this FMU has no event mode; instantiate it without";
    if (wrong) {
        refuse(rig, "%s", wrong);
        free_rig(rig);
        return NULL;
    }

    char exporter[TEXT_BYTES];
    const char *program = getenv("ROLLERRIG_PYTHON");
    if (!program || !*program) {
        program = "python3";
        if (read_line(resourcePath, "python.txt", exporter, sizeof exporter) &&
            access(exporter, X_OK) == 0)
            program = exporter;
    }
    rig->output = tmpfile();
    int error = start(rig, program, resourcePath);
    if (error) {
        refuse(rig,
               "cannot start %s: %s; the rig needs Python with rollerrig: name it in the variable "
               "ROLLERRIG_PYTHON",
               program, strerror(error));
        free_rig(rig);
        return NULL;
    }
    /* the first answer comes when everything is compiled */
    if (answer(rig, NULL, 0) != fmi3OK) {
        free_rig(rig);
        return NULL;
    }
    return rig;
}

void fmi3FreeInstance(fmi3Instance instance) {
    if (instance) free_rig(instance);
}

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean loggingOn, size_t nCategories,
                               const fmi3String categories[]) {
    return instance ? fmi3OK : fmi3Error;
}

/* -- states */

static fmi3Status expect(const Rig *rig, State state, const char *function) {
    if (rig->state == state) return fmi3OK;
    if (rig->state == FAILED) return refuse(rig, "%s: the process of the rig is gone", function);
    return refuse(rig, "%s is not allowed in this state of the FMU", function);
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean toleranceDefined,
                                       fmi3Float64 tolerance, fmi3Float64 startTime,
                                       fmi3Boolean stopTimeDefined, fmi3Float64 stopTime) {
    Rig *rig = instance;
    if (!rig || expect(rig, INSTANTIATED, "fmi3EnterInitializationMode")) return fmi3Error;
    fmi3Status status = request(rig, 'I', &startTime, sizeof startTime, NULL, 0, NULL, 0);
    if (status == fmi3OK) rig->state = INITIALIZING;
    return status;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance) {
    Rig *rig = instance;
    if (!rig || expect(rig, INITIALIZING, "fmi3ExitInitializationMode")) return fmi3Error;
    rig->state = STEPPING;
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance instance) {
    Rig *rig = instance;
    if (!rig || expect(rig, STEPPING, "fmi3Terminate")) return fmi3Error;
    rig->state = TERMINATED;
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance instance) {
    Rig *rig = instance;
    if (!rig) return fmi3Error;
    fmi3Status status = request(rig, 'R', NULL, 0, NULL, 0, NULL, 0);
    if (status == fmi3OK) rig->state = INSTANTIATED;
    return status;
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 currentCommunicationPoint,
                      fmi3Float64 communicationStepSize,
                      fmi3Boolean noSetFMUStatePriorToCurrentPoint,
                      fmi3Boolean *eventHandlingNeeded, fmi3Boolean *terminateSimulation,
                      fmi3Boolean *earlyReturn, fmi3Float64 *lastSuccessfulTime) {
    Rig *rig = instance;
    if (eventHandlingNeeded) *eventHandlingNeeded = fmi3False;
    if (terminateSimulation) *terminateSimulation = fmi3False;
    if (earlyReturn) *earlyReturn = fmi3False;
    if (!rig || expect(rig, STEPPING, "fmi3DoStep")) return fmi3Error;
    double step[] = {currentCommunicationPoint, communicationStepSize};
    fmi3Status status = request(rig, 'D', step, sizeof step, NULL, 0, &rig->time_s, sizeof(double));
    if (lastSuccessfulTime) *lastSuccessfulTime = rig->time_s;
    return status;
}

/* -- values */

/* Returns whether a call for values is one that the process can answer. */
static int may_transfer(const Rig *rig, const void *references, size_t count, const void *values,
                        size_t values_count, const char *function) {
    if (!rig) return 0;
    if (rig->state == FAILED) return expect(rig, STEPPING, function) == fmi3OK;
    if (count == values_count && (!count || (references && values))) return 1;
    refuse(rig, "%s: %zu references and %zu values; every variable has one value", function, count,
           values_count);
    return 0;
}

fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                          size_t nValueReferences, fmi3Float64 values[], size_t nValues) {
    if (!may_transfer(instance, valueReferences, nValueReferences, values, nValues,
                      "fmi3GetFloat64"))
        return fmi3Error;
    return request(instance, 'G', valueReferences, nValueReferences * sizeof *valueReferences, NULL,
                   0, values, nValues * sizeof *values);
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                          size_t nValueReferences, const fmi3Float64 values[], size_t nValues) {
    if (!may_transfer(instance, valueReferences, nValueReferences, values, nValues,
                      "fmi3SetFloat64"))
        return fmi3Error;
    return request(instance, 'S', valueReferences, nValueReferences * sizeof *valueReferences,
                   values, nValues * sizeof *values, NULL, 0);
}

/* A Boolean of FMI 3 is a bool of C, one byte. */
_Static_assert(sizeof(fmi3Boolean) == 1, "a Boolean takes one byte");

fmi3Status fmi3GetBoolean(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                          size_t nValueReferences, fmi3Boolean values[], size_t nValues) {
    if (!may_transfer(instance, valueReferences, nValueReferences, values, nValues,
                      "fmi3GetBoolean"))
        return fmi3Error;
    return request(instance, 'g', valueReferences, nValueReferences * sizeof *valueReferences, NULL,
                   0, values, nValues * sizeof *values);
}

fmi3Status fmi3SetBoolean(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                          size_t nValueReferences, const fmi3Boolean values[], size_t nValues) {
    if (!may_transfer(instance, valueReferences, nValueReferences, values, nValues,
                      "fmi3SetBoolean"))
        return fmi3Error;
    return request(instance, 's', valueReferences, nValueReferences * sizeof *valueReferences,
                   values, nValues * sizeof *values, NULL, 0);
}
